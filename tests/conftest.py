"""JAX set up as users set it up, before anything else, and what many tests share."""

import os
import signal
import sys
from datetime import date
from pathlib import Path
from zlib import crc32

import psutil
import pytest
from hypothesis import settings

from tests.compiling import forget_programs, trace_quickly, unoptimised

settings.register_profile("repeatable", derandomize=True, deadline=None, database=None, max_examples=50)
settings.load_profile("repeatable")

MANY_MAPS = 20_000
"""Memory maps of a process from which on compiled programs are forgotten; Linux allows 65 530."""
MUCH_MEMORY = 1.0e9
"""Bytes of a process from which on compiled programs are forgotten after a file; the tests of a file share programs,
files few."""
MOST_MEMORY = 1.75e9
"""Bytes of a process from which on programs are forgotten after any test, which the next tests of a file compile again;
two workers with 2 GiB each fit into a small machine."""
GROWTH = 2e8
"""Fewest bytes that tests add between two times when programs are forgotten: else a process that stays large would
forget after every test."""
LONGEST = ("textbook", "verification", "steppers", "pages")
"""Folders whose files take longest come first, so that workers end together."""


def pytest_addoption(parser):
    parser.addoption("--full", action="store_true", help="also the tests that take long")
    parser.addoption(
        "--budget",
        action="store_true",
        help="fail if a test or a file compiles more programs than tests/durations.py allows",
    )
    parser.addoption("--quick", action="store_true", help="refusals and structure, tests that compile nothing")
    parser.addoption(
        "--unoptimised",
        action="store_true",
        help="programs are compiled without LLVM's optimisations, in about a third of the time",
    )
    parser.addoption("--tenth", action="store_true", help="one tenth of the files, others every day")
    parser.addoption("--matrix", help="matrix of solvers wherever a test does not choose one; default auto")
    parser.addoption(
        "--kernels", choices=["plain", "cpu"], help="which small dense algebra; default: the package's own"
    )


def pytest_configure(config):
    kernels = config.getoption("--kernels")
    if kernels is not None:
        if "vmri_jax" in sys.modules:
            raise pytest.UsageError(
                "--kernels: vmri_jax is imported already; import it in fixtures of conftest.py only"
            )
        os.environ["VMRI_KERNELS"] = kernels  # read where the package is imported, also in processes of tests
    cache = config.cache.mkdir("programs")
    os.environ["XDG_CACHE_HOME"] = str(cache)  # processes of tests that call `vmri` or workers of ensembles
    from vmri_jax.configure import SECONDS_WORTH_KEEPING, cache_folder, configure

    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(cache_folder())  # all other processes of tests
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = str(SECONDS_WORTH_KEEPING)
    if config.getoption("--unoptimised"):
        unoptimised()
    configure(cache=cache_folder())
    trace_quickly()
    from tests.durations import Durations
    from tests.programs import Programs  # they import JAX, which is configured by now
    from tests.quick import Quick

    programs = Programs()
    config.pluginmanager.register(programs, "programs")
    config.pluginmanager.register(Durations(programs, config.getoption("--budget")), "durations")
    if config.getoption("--quick"):
        config.pluginmanager.register(Quick(programs), "quick")
    # Tests make functions of one piece of code again for each case, runs that lose their energy, and starts with random
    # velocities.
    config.addinivalue_line("filterwarnings", "ignore::vmri_jax.CompiledAgainWarning")
    config.addinivalue_line("filterwarnings", "ignore::vmri_jax.LostEnergyWarning")
    config.addinivalue_line("filterwarnings", "ignore:.*project=True has replaced them")


def pytest_ignore_collect(collection_path, config):
    """With --tenth: files are in the tenth of a day by a checksum of the date and their names."""
    if not config.getoption("--tenth") or not collection_path.name.startswith("test_"):
        return None
    return crc32(f"{date.today()} {collection_path.name}".encode()) % 10 > 0 or None


def pytest_collection_modifyitems(config, items):
    items.sort(key=lambda item: item.path.parent.name not in LONGEST)
    if not config.getoption("--full"):
        for item in items:
            if item.get_closest_marker("full"):
                item.add_marker(pytest.mark.skip(reason="takes long; run with --full"))


LEFT = pytest.StashKey[float]()
"""Bytes that were left when programs were forgotten last."""


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item, nextitem):
    """Compiled programs go when they hold too many memory maps or too much memory; until then tests share them."""
    result = yield
    maps, process, stash = Path("/proc/self/maps"), psutil.Process(), item.config.stash
    many_maps = maps.exists() and maps.read_bytes().count(b"\n") > MANY_MAPS
    ends_file = nextitem is None or nextitem.path != item.path
    most = max(MUCH_MEMORY if ends_file else MOST_MEMORY, stash.get(LEFT, 0.0) + GROWTH)
    if many_maps or process.memory_info().rss > most:
        forget_programs()
        stash[LEFT] = process.memory_info().rss
    return result


@pytest.fixture(scope="session", autouse=True)
def default_matrix(request):
    """`Solver()` has the matrix of the command line: the tests hold for every matrix."""
    from vmri_jax import Solver

    matrix, made = request.config.getoption("--matrix"), Solver.__init__
    if matrix is None:
        yield
        return

    def with_matrix(self, *arguments, **settings):
        chosen = arguments or "matrix" in settings or "stepper" in settings
        made(self, *arguments, **({} if chosen else {"matrix": matrix}) | settings)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Solver, "__init__", with_matrix)
        yield


@pytest.fixture(scope="session")
def fpu():
    """The Fermi-Pasta-Ulam chain with three stiff springs."""
    from vmri_jax import systems

    return systems.fermi_pasta_ulam()


@pytest.fixture(scope="session")
def tsp():
    """The triple spherical pendulum."""
    from vmri_jax import systems

    return systems.triple_spherical_pendulum()


@pytest.fixture(scope="session")
def sam():
    """The simple atomic model."""
    from vmri_jax import systems

    return systems.simple_atomic_model()


@pytest.fixture(autouse=True)
def ctrl_c():
    """Ctrl-C interrupts, also where the tests run in the background of a shell."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)

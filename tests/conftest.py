"""64-bit floats before anything else, and what many tests share."""

import os
import signal

# Most of the time goes into compiling; with the older code generator of XLA it takes three quarters of it.
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_use_fusion_emitters=false".strip()

import jax
import pytest
from hypothesis import settings

jax.config.update("jax_enable_x64", True)

settings.register_profile("repeatable", derandomize=True, deadline=None, database=None, max_examples=50)
settings.load_profile("repeatable")


@pytest.fixture(scope="module", autouse=True)
def forget_programs():
    """Compiled programs of a module go when it is done: each holds memory maps, of which a process has only so many."""
    yield
    jax.clear_caches()


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


def pytest_collection_modifyitems(config, items):
    if not config.getoption("--full"):
        for item in items:
            if item.get_closest_marker("full"):
                item.add_marker(pytest.mark.skip(reason="takes long; run with --full"))


def pytest_addoption(parser):
    parser.addoption("--full", action="store_true", help="also the tests that take long")
    parser.addoption("--method", help="method of Newton's iteration wherever a test does not choose one; default auto")


@pytest.fixture(scope="session", autouse=True)
def default_method(request):
    """`Newton()` with the method of the command line: the tests hold for every method."""
    from vmri_jax import Newton

    method = request.config.getoption("--method")
    if method is None:
        yield
        return
    with pytest.MonkeyPatch.context() as patch:
        defaults = Newton.__init__.__defaults__ or ()
        patch.setattr(Newton.__init__, "__defaults__", (method, *defaults[1:]))
        assert Newton().method == method
        yield

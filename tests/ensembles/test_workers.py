"""Ensembles on workers: the same to the last bit wherever they are computed, and whatever dies."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import psutil
import pytest

import vmri_jax as vm
from tests.ensembles import own
from tests.ensembles.test_ensemble import OWN
from tests.user_systems import two_oscillators
from vmri_jax.ensembles import EnsembleError
from vmri_jax.executors.executor import NotAWorker, in_worker, package_versions
from vmri_jax.stability import stability_map
from vmri_jax.study import convergence_study

distributed = pytest.importorskip("distributed")
pytestmark = pytest.mark.filterwarnings("default")  # of Dask, about ports and slow loops

DESIGN = {"omega": np.linspace(20.0, 50.0, 32), "num_micro": [1, 3]}
ARGUMENTS = {"t_end": 0.2, "macro_dt": 0.02, "save": ("end", f"{OWN}:reach"), "num_saves": 5, "chunk": 16}
ROOT = Path(__file__).parents[2]
"""Four chunks."""


SLOW = {"save": ("end", f"{OWN}:sleeps"), "chunk": 8}
"""Eight chunks that take a moment each."""


def sweep(out: Path, **changes):
    return vm.ensemble(
        **{"system": "fpu", "scheme": "explicit-slow", "design": DESIGN, "vary": own.put, **ARGUMENTS} | changes,
        out=out,
    )


def contents(path: Path) -> dict[str, bytes]:
    return {str(file.relative_to(path)): file.read_bytes() for file in path.rglob("*") if file.is_file()}


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """Compiled programs of all workers of these tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def here(tmp_path_factory):
    """What the sweep gives in this process."""
    return contents(sweep(tmp_path_factory.mktemp("here") / "runs.zarr").path)


@pytest.fixture(scope="module")
def here_slowly(tmp_path_factory):
    """What the slow one gives in this process."""
    return contents(sweep(tmp_path_factory.mktemp("here") / "runs.zarr", **SLOW).path)


@pytest.fixture(scope="module")
def client(cache):
    """A client of two workers of a cluster of this machine."""
    cluster = distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0")
    with cluster, distributed.Client(cluster) as client:
        yield client


def test_a_cluster_of_this_machine(tmp_path, client, here):
    assert contents(sweep(tmp_path / "runs.zarr", executor=client).path) == here


def test_processes(tmp_path, cache, here):
    assert contents(sweep(tmp_path / "runs.zarr", processes=2).path) == here


def test_any_executor_that_spawns(tmp_path, cache, here):
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        assert contents(sweep(tmp_path / "runs.zarr", executor=pool).path) == here


def test_scheduler_and_workers_started_as_commands(tmp_path, cache, here):
    with scheduler_and_worker(tmp_path) as address, distributed.Client(address) as client:
        assert contents(sweep(tmp_path / "runs.zarr", executor=client).path) == here


def test_problems_and_schemes_travel(tmp_path, client):
    schemes = {"a": vm.explicit_slow(2), "b": vm.fully_implicit(2)}
    arguments = {"scheme": schemes, "design": {"omega": [20.0, 50.0]}, "save": "end", "chunk": 2}
    one = sweep(tmp_path / "one.zarr", system=vm.systems.fermi_pasta_ulam(), **arguments)
    two = sweep(tmp_path / "two.zarr", system=vm.systems.fermi_pasta_ulam(), **arguments, executor=client)
    assert contents(one.path) == contents(two.path)


def test_a_function_of_rows_travels(tmp_path, client):
    design = {"frequency": [20.0, 50.0], "speed": [1.0]}
    arguments = {
        "system": vm.systems.fermi_pasta_ulam(),
        "design": design,
        "vary": own.faster,
        "chunk": 1,
        "num_micro": 2,
    }
    here = sweep(tmp_path / "one.zarr", **arguments)
    assert contents(here.path) == contents(sweep(tmp_path / "two.zarr", **arguments, executor=client).path)


def test_studies_travel(client):
    """With the cluster as an executor; `tests/study/test_convergence.py` says more about their results."""
    problem, schemes = two_oscillators(), {str(n): vm.fully_explicit(n) for n in (2, 5)}
    study = partial(convergence_study, problem, schemes, [0.02, 0.01], 0.2, num_saves=2)
    assert study().to_pandas().equals(study(executor=client).to_pandas())
    here, there = (stability_map(problem, schemes, np.linspace(1.5, 6.0, 12), executor=e) for e in (None, client))
    assert np.allclose(here.radius, there.radius, rtol=0, atol=1e-12)
    assert here.rows == there.rows


def test_a_worker_that_is_killed(tmp_path, client, here_slowly):
    pids = list(client.run(os.getpid).values())
    out = tmp_path / "runs.zarr"

    with at_first_chunk(out, lambda: os.kill(pids[0], signal.SIGKILL)):
        runs = sweep(out, **SLOW, executor=client)
    assert runs.complete
    assert contents(out) == here_slowly


def test_ctrl_c(tmp_path, client, here_slowly):
    out = tmp_path / "runs.zarr"
    with (
        at_first_chunk(out, lambda: os.kill(os.getpid(), signal.SIGINT)),
        pytest.raises(vm.Interrupted, match="go on with"),
    ):
        sweep(out, **SLOW, executor=client)
    assert sweep(out, **SLOW, executor=client, resume=True).complete
    assert contents(out) == here_slowly


def test_runs_that_kill_their_workers_are_named(tmp_path, client):
    design = {"q_s[0]": [1.0, 2.0, own.POISON, 4.0]}
    message = r"1 of 4 chunks could not be computed: runs 2 to 2\. .*KilledWorker"
    with few_deaths(client), pytest.raises(EnsembleError, match=message):
        sweep(tmp_path / "runs.zarr", design=design, save=f"{OWN}:dies", chunk=1, num_micro=2, executor=client)


@contextmanager
def few_deaths(client):
    """Dask gives a task up after the first worker that dies of it."""
    before = client.cluster.scheduler.allowed_failures
    client.cluster.scheduler.allowed_failures = 0
    yield
    client.cluster.scheduler.allowed_failures = before


def test_this_process_is_killed(tmp_path, cache, here_slowly):
    """Also its workers end; resumed it is the same."""
    out = tmp_path / "runs.zarr"
    program = tmp_path / "program.py"
    arguments = ARGUMENTS | SLOW
    program.write_text(
        "import numpy as np\nimport vmri_jax as vm\n\n"
        "if __name__ == '__main__':\n"
        "    vm.configure()\n"
        "    from tests.ensembles import own\n\n"
        "    design = {'omega': np.linspace(20.0, 50.0, 32), 'num_micro': [1, 3]}\n"
        f"    how = {arguments!r}\n"
        f"    vm.ensemble('fpu', 'explicit-slow', design, vary=own.put, **how, out={str(out)!r}, processes=1)\n"
    )
    process = subprocess.Popen([sys.executable, str(program)], env=os.environ | {"PYTHONPATH": str(ROOT)})
    wait_for(lambda: len(list(out.glob("resume/chunks/[0-9]*"))) > 1)
    children = psutil.Process(process.pid).children(recursive=True)
    process.kill()
    process.wait()
    _, alive = psutil.wait_procs(children, timeout=20)
    assert not alive
    assert 1 < len(list(out.glob("resume/chunks/[0-9]*"))) < 8
    assert sweep(out, **SLOW, resume=True).complete
    assert contents(out) == here_slowly


def test_a_scheduler_that_goes_away(tmp_path, cache):
    out = tmp_path / "runs.zarr"
    message = r"the workers, or their scheduler, are gone\. .* go on with resume=True"
    with scheduler_and_worker(tmp_path) as address, distributed.Client(address, timeout=2) as client:
        scheduler = client.run_on_scheduler(os.getpid)
        with (
            at_first_chunk(out, lambda: os.kill(scheduler, signal.SIGKILL)),
            pytest.raises(RuntimeError, match=message),
        ):
            sweep(out, **SLOW, executor=client)
    assert sweep(out, **SLOW, resume=True).complete


HIDE = """
import importlib.metadata
import sys


def version(name):
    raise importlib.metadata.PackageNotFoundError(name)


importlib.metadata.version = version
sys.modules["vmri_jax"] = None
"""
"""A worker without the package."""


def test_workers_without_the_package(tmp_path, cache):
    hide = tmp_path / "hide.py"
    hide.write_text(HIDE)
    missing = pytest.raises(NotAWorker, match="a worker does not have vmri_jax")
    with (
        scheduler_and_worker(tmp_path, "--preload", str(hide)) as address,
        distributed.Client(address) as client,
        missing,
    ):
        sweep(tmp_path / "runs.zarr", executor=client)


def test_workers_of_another_version(tmp_path, monkeypatch):
    versions = package_versions() | {"vmri_jax": "0.0.1"}
    with pytest.raises(NotAWorker, match=r"vmri_jax .* instead of 0\.0\.1.*give all workers the same versions"):
        in_worker(versions, b"")


def test_processes_that_run_jax_already():
    jnp.zeros(1)
    program = (
        "import jax.numpy as jnp\njnp.zeros(1)\n"
        "from vmri_jax.executors.executor import in_worker, package_versions\nin_worker(package_versions(), b'')"
    )
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=environment)
    assert re.search(r"NotAWorker: process \d+ .* runs JAX already, .*get_context\('spawn'\)", done.stderr)


def test_a_file_that_is_another_one(tmp_path, client):
    file = tmp_path / "mine.py"
    file.write_text("from vmri_jax import systems\nchain = systems.fermi_pasta_ulam()\n")
    sweep(tmp_path / "runs.zarr", system=f"{file}:chain", save="end")
    file.write_text("from vmri_jax import systems\nchain = systems.fermi_pasta_ulam(omega=20.0)\n")
    with pytest.raises(ValueError, match=r"holds another ensemble .*file mine\.py"):
        sweep(tmp_path / "runs.zarr", system=f"{file}:chain", save="end", resume=True)


def test_systems_that_workers_cannot_import(tmp_path, client):
    def fast_potential(q_f, params):
        return params["omega"] ** 2 * jnp.sum(q_f**2) / 2

    system = vm.systems.fermi_pasta_ulam().system.replace(fast_potential=fast_potential)
    problem = vm.Problem(system, [1.0, 0.0, 0.0], [0.1, 0.0, 0.0])
    with pytest.raises(ValueError, match=r"workers cannot import this system or scheme .*Put the problem into a file"):
        sweep(tmp_path / "runs.zarr", system=problem, save="end", executor=client)
    assert not (tmp_path / "runs.zarr").exists()
    assert sweep(tmp_path / "runs.zarr", system=problem, save="end").complete


def test_executor_and_processes(tmp_path):
    with pytest.raises(ValueError, match="executor and processes are given"):
        sweep(tmp_path / "runs.zarr", executor=object(), processes=2)
    with pytest.raises(ValueError, match="processes is 0"):
        sweep(tmp_path / "runs.zarr", processes=0)


@contextmanager
def at_first_chunk(out: Path, act):
    """Meanwhile, do something when the first chunk of an ensemble is done."""

    def wait():
        wait_for(lambda: any(out.glob("resume/chunks/[0-9]*")))
        act()

    thread = threading.Thread(target=wait, daemon=True)
    thread.start()
    yield
    thread.join(60)


@contextmanager
def scheduler_and_worker(folder: Path, *options: str):
    """`dask scheduler` and `dask worker` of one process each; yields the address."""
    file = folder / "scheduler.json"
    command = [sys.executable, "-m", "dask"]
    none = subprocess.DEVNULL
    place = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file)]
    scheduler = subprocess.Popen([*command, "scheduler", *place], stdout=none, stderr=none)
    wait_for(file.exists)
    worker = subprocess.Popen(
        [*command, "worker", "--scheduler-file", str(file), "--nthreads", "1", "--no-dashboard", *options],
        stdout=none,
        stderr=none,
    )
    try:
        yield json.loads(file.read_text())["address"]
    finally:
        for process in (worker, scheduler):
            process.terminate()
        for process in (worker, scheduler):
            process.wait(20)


def wait_for(condition, seconds: float = 30.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)

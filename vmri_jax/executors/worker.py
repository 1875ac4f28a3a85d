"""Calls in worker processes: how the arguments are sent, and how JAX is set up before a worker uses it.

A worker gets bytes and unpacks them after it has set up JAX: to unpack an array of JAX starts JAX, with default settings.
"""

import os
import pickle
import socket
from collections.abc import Callable
from functools import lru_cache
from importlib.metadata import version

from vmri_jax.configure import cache_folder, configure, processor
from vmri_jax.refusals import Refused

PACKAGES = ("vmri_jax", "jax", "jaxlib")
"""Packages on whose versions the last digits of a run depend."""


class NotAWorker(RuntimeError):
    """A process cannot be a worker: it has other versions of packages, or JAX runs in it with other settings."""


@lru_cache
def known_versions() -> dict[str, str]:
    """Versions of `PACKAGES` in this process."""
    return {name: version(name) for name in PACKAGES}


def packed(caller: str, task: Callable, *shared) -> bytes:
    """A function and its first arguments as bytes that another process can read; refuses functions that workers cannot import."""
    try:
        data = pickle.dumps((task, shared))
        if b"__main__" in data:
            raise pickle.PicklingError("it has functions of the running program")
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise Refused(
            f"{caller}: workers cannot import this system or scheme ({error}): functions of the running program or of an "
            "interactive session, lambdas, and functions within functions. Put the problem into a file, "
            "'my_file.py:my_problem', or into a package that workers have, 'my_package.my_module:my_problem'."
        ) from error
    return data


def in_worker(versions: dict[str, str], data: bytes, *plain):
    """Set up JAX in this process and return ``task(*shared, *plain)`` for the task that `packed` has packed.

    Refuses a process with other `versions` than the one that started the work, or one where JAX has started with other settings.
    """
    here = known_versions()
    differ = [f"{name} {here[name]} instead of {versions[name]}" for name in versions if here[name] != versions[name]]
    if differ:
        worker = f"the worker on {socket.gethostname()} has {', '.join(differ)}"
        raise NotAWorker(f"{worker}. Results would differ in their last digits: give all workers the same versions.")
    _prepare(os.getpid())
    task, shared = _unpacked(data)
    return task(*shared, *plain)


@lru_cache(maxsize=4)
def _unpacked(data: bytes) -> tuple[Callable, tuple]:
    return pickle.loads(data)


@lru_cache(maxsize=1)
def _prepare(process: int) -> None:
    """One thread, 64-bit floats, fast loops, and compiled programs on disk in a folder for this kind of processor.

    `process` is the number of this process; a forked process has another one, and prepares itself again.
    """
    os.environ.setdefault("PJRT_NPROC", "1")
    try:
        configure(cache=cache_folder() / "workers" / processor())
    except RuntimeError as error:
        raise NotAWorker(
            f"process {process} on {socket.gethostname()} runs JAX already, without the settings of vmri_jax; perhaps it "
            "was forked. Give new processes, ProcessPoolExecutor(n, mp_context=multiprocessing.get_context('spawn'))."
        ) from error

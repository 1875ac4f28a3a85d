"""Other processes: what they are told, and what they do before JAX starts in them.

They get bytes, and unpack them when JAX has its settings: arrays of JAX that are unpacked would start it.
"""

import os
import pickle
import socket
from collections.abc import Callable
from functools import lru_cache
from typing import Any

from vmri_jax.configure import cache_folder, configure, processor
from vmri_jax.running.store.identity import environment

VERSIONS = ("vmri_jax", "jax", "jaxlib")


class NotAWorker(RuntimeError):
    """A process cannot be a worker: it has other versions, or JAX runs there with other settings."""


@lru_cache
def known_versions() -> dict[str, str]:
    """Versions that decide the last digits of a run."""
    found = environment()
    return {name: found[name] for name in VERSIONS}


def packed(what: str, value: Any) -> bytes:
    """A value as bytes that another process can read.

    Args:
        what: the function that was called, for messages.

    Raises:
        ValueError: it has functions that workers cannot import, with what to do.
    """
    try:
        data = pickle.dumps(value)
        if b"__main__" in data:
            raise pickle.PicklingError("it has functions of the program that is running")
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise ValueError(
            f"{what}: workers cannot import this system or scheme ({error}). Functions of the program that is running, of an "
            "interactive session, made within another function or by lambda have no name that other processes find. Put the "
            "problem into a file and give its name, 'my_file.py:my_problem', or into a package that workers have, "
            "'my_package.my_module:my_problem'."
        ) from error
    return data


class _Call:
    """A call whose pickle, when it is loaded, gives its result."""

    def __init__(self, function: Callable, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


def call_in_worker(versions: dict[str, str], task: Callable, packed: bytes, *plain) -> tuple[Callable, bytes]:
    """A function and its argument for an executor, which make the call of `in_worker`.

    Both are none of this package, so that a worker without it can say so: Dask's end when they get a task that they cannot read.
    """
    return pickle.loads, pickle.dumps(_Call(in_worker, versions, task, packed, *plain))


def in_worker(versions: dict[str, str], task: Callable, packed: bytes, *plain):
    """``task(packed, *plain)`` in another process, where JAX has its settings.

    Args:
        versions: of the process that started the work.

    Raises:
        NotAWorker: this process has others, or JAX has started here without these settings.
    """
    here = known_versions()
    differ = [
        f"{name} {here[name]} instead of {version}" for name, version in versions.items() if here[name] != version
    ]
    if differ:
        raise NotAWorker(
            f"the worker on {socket.gethostname()} has {', '.join(differ)}. Results would differ in their last digits: give all "
            "workers the versions of the process that starts them."
        )
    _prepare(os.getpid())
    return task(packed, *plain)


def call_packed(packed: bytes):
    """``task(*arguments)`` of these, pickled."""
    task, arguments = pickle.loads(packed)
    return task(*arguments)


@lru_cache(maxsize=1)
def _prepare(process: int) -> None:
    """One thread, 64-bit floats, fast loops, and compiled programs kept on disk, by kind of processor."""
    os.environ.setdefault("PJRT_NPROC", "1")
    try:
        configure(cache=cache_folder() / "workers" / processor())
    except RuntimeError as error:
        raise NotAWorker(
            f"process {process} on {socket.gethostname()} runs JAX already, without the settings of vmri_jax, perhaps since it was "
            "forked. Give an executor that starts processes anew, ProcessPoolExecutor(n, "
            "mp_context=multiprocessing.get_context('spawn')), and workers that have done nothing else with JAX."
        ) from error

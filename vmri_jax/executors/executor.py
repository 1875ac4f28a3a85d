"""Executors of tasks: this process, workers on this machine, or an executor that the user gives.

A worker gets bytes and unpacks them after it has set up JAX: to unpack an array of JAX starts JAX, with default
settings.
"""

import os
import pickle
import socket
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from contextlib import ExitStack, contextmanager
from functools import lru_cache, partial
from importlib.metadata import PackageNotFoundError, version
from itertools import islice
from typing import Any

from vmri_jax.configure import cache_folder, configure, processor
from vmri_jax.mechanics.arrays import whole_number
from vmri_jax.mechanics.checks import check_type
from vmri_jax.refusals import Refused
from vmri_jax.running.export import extra
from vmri_jax.running.interrupts import Interrupted, interrupts_noted
from vmri_jax.running.store.identity import package_versions

DASK_RETRIES = 2
"""Number of times that Dask repeats a task that raised an error; a larger one delays the report of an error that is no
accident. A setting of Dask tells how often it repeats a task whose worker died."""
MOST_UNDER_WAY = 1000
"""Largest number of tasks that an executor has at once: enough for several hundred workers. The arguments of all of
them are in memory: with a larger number ensembles of large systems need more of it, with a smaller one large clusters
wait for tasks."""
POLL_SECONDS = 1.0
"""Seconds between two looks at the workers and at all futures: `wait` does not return for futures that Dask cancels
when its scheduler ends. With a larger value the program notices later that the scheduler is gone."""


class NotAWorker(RuntimeError):
    """A process cannot be a worker: it has other versions of packages, or JAX runs in it with other settings."""


def packed(caller: str, task: Callable, *shared) -> bytes:
    """A function and its first arguments as bytes that another process can read; refuses functions that workers cannot
    import."""
    try:
        data = pickle.dumps((task, shared))
        if b"__main__" in data:
            raise pickle.PicklingError("it has functions of the running program")
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise Refused(
            f"{caller}: workers cannot import this system or scheme ({error}): functions of the running program or of "
            "an interactive session, lambdas, and functions within functions. Put the problem into a file, "
            "'my_file.py:my_problem', or into a package that workers have, 'my_package.my_module:my_problem'."
        ) from error
    return data


def in_worker(versions: dict[str, str], data: bytes, *plain):
    """Set up JAX in this process and return ``task(*shared, *plain)`` for the task that `packed` has packed.

    Refuses a process with other `versions` than the one that started the work, or one where JAX has started with other
    settings.
    """
    here = package_versions()
    differ = [f"{name} {here[name]} instead of {versions[name]}" for name in versions if here[name] != versions[name]]
    if differ:
        worker = f"the worker on {socket.gethostname()} has {', '.join(differ)}"
        raise NotAWorker(f"{worker}. Results would differ in their last digits: give all workers the same versions.")
    _prepare(os.getpid())
    task, shared = _unpacked(data)
    return task(*shared, *plain)


_unpacked = lru_cache(maxsize=4)(pickle.loads)


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
            f"process {process} on {socket.gethostname()} runs JAX already, without the settings of vmri_jax; perhaps "
            "it was forked. Give new processes, ProcessPoolExecutor(n, "
            "mp_context=multiprocessing.get_context('spawn'))."
        ) from error


class Here(Executor):
    """Runs every task in this process, within `submit`."""

    def submit(self, fn: Callable, /, *args, **kwargs) -> Future:
        future: Future = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


@contextmanager
def executor_of(caller: str, executor: Any, processes: int | None = None) -> Iterator[Executor]:
    """The `concurrent.futures.Executor` that computes the tasks of a call; `executor` and `processes` are those of
    `ensemble`."""
    if executor is not None and processes is not None:
        raise Refused(f"{caller}: executor and processes are given; choose one of them.")
    with ExitStack() as resources:
        if processes is not None:
            executor = resources.enter_context(local_workers(whole_number(f"{caller}: processes", processes)))
        if executor is not None and hasattr(executor, "get_executor"):
            executor = executor.get_executor(retries=DASK_RETRIES, pure=False)
        kinds = "a dask.distributed.Client or a concurrent.futures.Executor"
        check_type(f"{caller}: executor", executor, Executor | None, kinds)
        try:
            # A function of Python's library: a worker of Dask that cannot import the function of a task ends, and the
            # task never does.
            if executor is not None:
                executor.submit(version, "vmri_jax").result()
        except PackageNotFoundError as error:
            raise NotAWorker(f"{caller}: a worker does not have vmri_jax; install it there.") from error
        yield Here() if executor is None else executor


@contextmanager
def local_workers(count: int) -> Iterator[Any]:
    """A client of `count` workers on this machine, each a process with one thread."""
    distributed = extra("distributed", "processes=", "ensemble")
    cluster = distributed.LocalCluster(n_workers=count, threads_per_worker=1, processes=True, dashboard_address=":0")
    with cluster, distributed.Client(cluster) as client:
        yield client


def submitter(caller: str, tasks: Executor, task: Callable, *shared) -> Callable[..., Future]:
    """The function of further arguments that has an executor compute ``task(*shared, *further)``, see `packed`."""
    if isinstance(tasks, Here):
        return partial(tasks.submit, task, *shared)
    return partial(tasks.submit, in_worker, package_versions(), packed(caller, task, *shared))


def as_done(
    submit: Callable[[int], Future], numbers: Iterable[int], interrupted: Callable[[], bool] = lambda: False
) -> Iterator[tuple[int, Future]]:
    """Submit tasks by their numbers, at most `MOST_UNDER_WAY` ahead, and yield each number with its future as the tasks
    end. ``interrupted()`` is polled: Python loses a `KeyboardInterrupt` in the finaliser of a future of Dask."""
    waiting: dict[Future, int] = {}
    left = iter(numbers)
    try:
        while True:
            if interrupted():
                raise KeyboardInterrupt
            for number in islice(left, MOST_UNDER_WAY - len(waiting)):
                future = submit(number)
                waiting[future] = number
                if future.done():
                    break
            if not waiting:
                return
            wait(waiting, POLL_SECONDS, FIRST_COMPLETED)
            for future in [future for future in waiting if future.done()]:
                yield waiting.pop(future), future
    finally:
        for future in waiting:
            future.cancel()


def mapped(
    caller: str,
    task: Callable,
    arguments: Iterable[tuple],
    executor: Any = None,
    report: Callable[[int, int], None] = lambda done, number: None,
) -> list:
    """``[task(*call) for call in arguments]``, computed by an executor as in `ensemble`; the first error is raised, and
    at Ctrl-C an `Interrupted` with the results up to then. ``report(done, number)``: before call `number` is submitted.
    """
    calls = list(arguments)
    results: list = [None] * len(calls)

    def done() -> int:
        return sum(result is not None for result in results)

    with ExitStack() as opened:
        tasks = opened.enter_context(executor_of(caller, executor))
        # In this process Ctrl-C stops the task itself, so that nothing has to poll.
        interrupted = (lambda: False) if isinstance(tasks, Here) else opened.enter_context(interrupts_noted())

        def submit(i: int) -> Future:
            report(done(), i)
            return submitter(caller, tasks, task, *calls[i])()

        try:
            for i, future in as_done(submit, range(len(calls)), interrupted):
                results[i] = future.result()
        except KeyboardInterrupt:
            raise Interrupted(results, done(), len(results), "calls") from None
    return results

"""Where tasks run: in this process, in workers of this machine, or wherever an executor has them run."""

import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, wait
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

from vmri_jax.ensembles.worker import call_in_worker, call_packed, known_versions, packed
from vmri_jax.mechanics.arrays import whole_number
from vmri_jax.running.interrupts import Interrupted, interrupts_noted

RETRIES = 2
"""Times that Dask tries a task again that raised an error. How often it does where workers died is its own setting."""
AHEAD = 4
"""Tasks per thread of the workers that are handed over before their time."""


LOOK = 1.0
"""Seconds after which workers are counted anew, and futures looked at: `wait` does not see those that Dask cancels when its
scheduler is gone."""


class Here(Executor):
    """Runs every task in this process, when it is submitted."""

    def submit(self, fn: Callable, /, *args, **kwargs) -> Future:
        future: Future = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


@contextmanager
def executor_of(what: str, executor: Any, processes: int | None) -> Iterator[tuple[Executor, Callable[[], int]]]:
    """An executor, and a function that says how many tasks it should have at a time.

    Args:
        what: the function that was called, for messages.
        executor: None, a `concurrent.futures.Executor`, or a `dask.distributed.Client`.
        processes: workers of this machine to start, None for none.

    Raises:
        TypeError, ValueError: something else, or both.
        ImportError: `processes` without Dask.
    """
    if executor is not None and processes is not None:
        raise ValueError(f"{what}: executor and processes are given; choose one of them.")
    with ExitStack() as open_ones:
        if processes is not None:
            executor = open_ones.enter_context(local_workers(whole_number(f"{what}: processes", processes)))
        if executor is None:
            yield Here(), lambda: 1
        elif isinstance(executor, Executor):
            size = getattr(executor, "_max_workers", 1)
            yield executor, lambda: AHEAD * size
        elif hasattr(executor, "get_executor"):
            tasks = executor.get_executor(retries=RETRIES, pure=False)
            try:
                yield tasks, _room(executor)
            finally:
                if executor.status == "running":
                    tasks.shutdown(wait=False)  # what is not done is not wanted any more
        else:
            raise TypeError(
                f"{what}: executor is {type(executor).__name__}; give a dask.distributed.Client or a concurrent.futures.Executor, "
                "or the number of processes on this machine."
            )


def _room(client: Any) -> Callable[[], int]:
    """How many tasks its workers should have; as many as before while the scheduler does not answer, none once it is given up."""
    known, asked = AHEAD, -LOOK

    def room() -> int:
        nonlocal known, asked
        if time.monotonic() - asked > LOOK:
            asked = time.monotonic()
            with suppress(OSError, RuntimeError, AttributeError):
                known = AHEAD * max(1, sum(client.nthreads().values()))
        return 0 if client.status == "closed" else known

    return room


@contextmanager
def local_workers(count: int) -> Iterator[Any]:
    """A client of so many workers on this machine, each a process with one thread.

    Raises:
        ImportError: Dask is not installed.
    """
    try:
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise ImportError("processes need Dask; install it with pip install 'vmri_jax[ensemble]'.") from error
    cluster = LocalCluster(n_workers=count, threads_per_worker=1, processes=True, dashboard_address=":0")
    with cluster, Client(cluster) as client:
        yield client


def as_done(
    submit: Callable[..., Future],
    room: Callable[[], int],
    arguments: Iterable[tuple],
    interrupted: Callable[[], bool] = lambda: False,
) -> Iterator[tuple[tuple, Future]]:
    """Submit all of these, not too many ahead, and yield them with their futures as they are done.

    Args:
        submit: starts one task.
        room: how many tasks may be under way.
        arguments: of every task.
        interrupted: whether Ctrl-C was pressed. Python loses a `KeyboardInterrupt` that falls into the finaliser of a future of
            Dask, so that Ctrl-C is noted and asked for here.

    Raises:
        CancelledError: there is no room any more: the workers are gone.
        KeyboardInterrupt: Ctrl-C was noted.
    """
    waiting: dict[Future, tuple] = {}
    left = iter(arguments)
    try:
        while True:
            if interrupted():
                raise KeyboardInterrupt
            if not room():
                raise CancelledError
            while len(waiting) < room() and (one := next(left, None)) is not None:
                waiting[submit(*one)] = one
            if not waiting:
                return
            wait(waiting, LOOK, FIRST_COMPLETED)
            for future in [future for future in waiting if future.done()]:
                yield waiting.pop(future), future
    finally:
        for future in waiting:
            future.cancel()


def mapped(
    what: str,
    task: Callable,
    arguments: Iterable[tuple],
    executor: Any = None,
    told: Callable[[int, int], None] = lambda done, number: None,
) -> list:
    """``[task(*one) for one in arguments]``, computed by an executor; the first error is raised.

    Args:
        what: the function that was called, for messages.
        task: a function of a module.
        arguments: of every call; they can be pickled if workers are to have them.
        executor: as of `ensemble`.
        told: ``told(done, number)``, how many are done when number `number` is handed over.

    Raises:
        Interrupted: Ctrl-C; carries the results until then.
    """
    given = list(arguments)
    found: list = [None] * len(given)
    with ExitStack() as opened:
        tasks, room = opened.enter_context(executor_of(what, executor, None))
        here, versions = isinstance(tasks, Here), known_versions()
        # A task of this process is stopped at once.
        interrupted = (lambda: False) if here else opened.enter_context(interrupts_noted())
        calls = ((i,) for i in range(len(given)))

        def submit(i: int) -> Future:
            told(sum(part is not None for part in found), i)
            if here:
                return tasks.submit(task, *given[i])
            return tasks.submit(*call_in_worker(versions, call_packed, packed(what, (task, given[i]))))

        try:
            for (i,), future in as_done(submit, room, calls, interrupted):
                found[i] = future.result()
        except KeyboardInterrupt:
            done = sum(result is not None for result in found)
            raise Interrupted(found, done, len(found), "calls") from None
    return found

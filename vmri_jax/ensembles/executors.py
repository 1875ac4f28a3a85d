"""Executors of tasks: this process, workers on this machine, or an executor that the user gives."""

import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, wait
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

from vmri_jax.ensembles.worker import call_in_worker, call_packed, known_versions, packed
from vmri_jax.mechanics.arrays import whole_number
from vmri_jax.running.export import extra
from vmri_jax.running.interrupts import Interrupted, interrupts_noted

DASK_RETRIES = 2
"""Number of times that Dask repeats a task that raised an error; a larger one delays the report of an error that is no accident. A
setting of Dask tells how often it repeats a task whose worker died."""
TASKS_PER_THREAD = 4
"""Tasks under way for each thread of the workers, so that no thread waits for the next task. With more of them more work is lost when the
program is stopped."""
POLL_SECONDS = 1.0
"""Seconds between two looks at the workers and at all futures: `wait` does not return for futures that Dask cancels when its scheduler
ends. With a larger value the program notices later that the scheduler is gone."""


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
def executor_of(caller: str, executor: Any, processes: int | None) -> Iterator[tuple[Executor, Callable[[], int]]]:
    """An executor, and a function that returns the number of tasks that it should have under way.

    Args:
        caller: name of the calling function, for messages.
        executor: None for this process, a `concurrent.futures.Executor`, or a `dask.distributed.Client`.
        processes: number of workers to start on this machine, or None.

    Raises:
        TypeError, ValueError: another executor, or both `executor` and `processes`.
        ImportError: `processes` without Dask.
    """
    if executor is not None and processes is not None:
        raise ValueError(f"{caller}: executor and processes are given; choose one of them.")
    with ExitStack() as resources:
        if processes is not None:
            executor = resources.enter_context(local_workers(whole_number(f"{caller}: processes", processes)))
        if executor is None:
            yield Here(), lambda: 1
        elif isinstance(executor, Executor):
            size = getattr(executor, "_max_workers", 1)
            yield executor, lambda: TASKS_PER_THREAD * size
        elif hasattr(executor, "get_executor"):
            tasks = executor.get_executor(retries=DASK_RETRIES, pure=False)
            try:
                yield tasks, _room(executor)
            finally:
                if executor.status == "running":
                    tasks.shutdown(wait=False)  # nobody needs the results of tasks that still run
        else:
            raise TypeError(
                f"{caller}: executor is {type(executor).__name__}; give a dask.distributed.Client or a concurrent.futures.Executor, "
                "or the number of processes on this machine."
            )


def _room(client: Any) -> Callable[[], int]:
    """A function that returns the number of tasks for all workers of a client.

    While the scheduler does not answer the number stays; once the client has closed it is 0.
    """
    tasks, counted_at = TASKS_PER_THREAD, -POLL_SECONDS

    def room() -> int:
        nonlocal tasks, counted_at
        if time.monotonic() - counted_at > POLL_SECONDS:
            counted_at = time.monotonic()
            with suppress(OSError, RuntimeError, AttributeError):
                tasks = TASKS_PER_THREAD * max(1, sum(client.nthreads().values()))
        return 0 if client.status == "closed" else tasks

    return room


@contextmanager
def local_workers(count: int) -> Iterator[Any]:
    """A client of `count` workers on this machine, each a process with one thread.

    Raises:
        ImportError: Dask is not installed.
    """
    distributed = extra("distributed", "processes=", "ensemble")
    cluster = distributed.LocalCluster(n_workers=count, threads_per_worker=1, processes=True, dashboard_address=":0")
    with cluster, distributed.Client(cluster) as client:
        yield client


def as_done(
    submit: Callable[..., Future],
    room: Callable[[], int],
    arguments: Iterable[tuple],
    interrupted: Callable[[], bool] = lambda: False,
) -> Iterator[tuple[tuple, Future]]:
    """Submit a task for each tuple of arguments, not too many ahead, and yield the arguments with the future as tasks end.

    Args:
        submit: starts one task.
        room: returns the largest number of tasks under way.
        arguments: a tuple for each task.
        interrupted: returns whether Ctrl-C was pressed. Python loses a `KeyboardInterrupt` that is raised in the finaliser of a future
            of Dask; therefore a handler notes Ctrl-C, and this function polls it.

    Raises:
        CancelledError: `room` returned 0: the workers are gone.
        KeyboardInterrupt: Ctrl-C was pressed.
    """
    waiting: dict[Future, tuple] = {}
    left = iter(arguments)
    try:
        while True:
            if interrupted():
                raise KeyboardInterrupt
            if not room():
                raise CancelledError
            while len(waiting) < room() and (call := next(left, None)) is not None:
                waiting[submit(*call)] = call
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
    """``[task(*call) for call in arguments]``, computed by an executor; the first error is raised.

    Args:
        caller: name of the calling function, for messages.
        task: a function that is defined in a module.
        arguments: a tuple for each call, which pickle can send if workers compute.
        executor: as in `ensemble`.
        report: ``report(done, number)``, the number of calls that are done when call `number` is submitted.

    Raises:
        Interrupted: Ctrl-C; carries the results up to then.
    """
    calls = list(arguments)
    results: list = [None] * len(calls)
    with ExitStack() as opened:
        tasks, room = opened.enter_context(executor_of(caller, executor, None))
        here, versions = isinstance(tasks, Here), known_versions()
        # In this process Ctrl-C stops the task itself, so that nothing has to poll.
        interrupted = (lambda: False) if here else opened.enter_context(interrupts_noted())
        numbers = ((i,) for i in range(len(calls)))

        def submit(i: int) -> Future:
            report(sum(part is not None for part in results), i)
            if here:
                return tasks.submit(task, *calls[i])
            return tasks.submit(*call_in_worker(versions, call_packed, packed(caller, (task, calls[i]))))

        try:
            for (i,), future in as_done(submit, room, numbers, interrupted):
                results[i] = future.result()
        except KeyboardInterrupt:
            done = sum(result is not None for result in results)
            raise Interrupted(results, done, len(results), "calls") from None
    return results

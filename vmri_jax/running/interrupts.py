"""Ctrl-C in a long run: the current piece is finished, and no computed step is lost."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class Interrupted(KeyboardInterrupt):
    """Ctrl-C stopped a run, a batch of tasks or a study; `.done` has all results computed before.

    It is a `KeyboardInterrupt`: a program that does not catch it stops, as after any Ctrl-C.

    Attributes:
        done: the `Trajectory` of `simulate`, the `StoredTrajectory` of `stream`, the `Report` of `check`, the
            `Ensemble` of an ensemble, the table of rows of a study, or the list of results of a mapping over tasks,
            with None for tasks that were not done.
        number: macro steps, tasks or rows done.
        total: their number in the complete work; None where it is not known before.
        units: their name, "macro steps", "cases", "chunks", "runs".
    """

    def __init__(self, done, number: int, total: int | None, units: str, advice: str = ""):
        self.done, self.number, self.total, self.units, self.advice = done, number, total, units, advice
        count = f"{number} {units}" if total is None else f"{number} of {total} {units}"
        super().__init__(f"interrupted after {count}; {advice or 'this exception has them in .done'}.")

    def __reduce__(self):
        return type(self), (self.done, self.number, self.total, self.units, self.advice)


@contextmanager
def interrupts_noted() -> Iterator[Callable[[], bool]]:
    """Context in which a first Ctrl-C is only noted and a second one raises; yields a function that tells whether
    Ctrl-C was pressed.

    Outside of the main thread, where Python allows no handlers, and where the program has its own handler, nothing
    changes.
    """
    default = signal.default_int_handler
    active = threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) is default
    noted = []

    def note(number, frame) -> None:
        noted.append(number)
        signal.signal(signal.SIGINT, default)

    if active:
        signal.signal(signal.SIGINT, note)
    try:
        yield lambda: bool(noted)
    finally:
        if active:
            signal.signal(signal.SIGINT, default)

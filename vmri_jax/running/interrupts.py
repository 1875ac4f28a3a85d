"""Ctrl-C in a long run: the piece at work is finished, nothing computed is lost."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class Interrupted(KeyboardInterrupt):
    """A run, a batch of tasks or a study was stopped by Ctrl-C; everything that was computed before is in `.done`.

    A `KeyboardInterrupt`: a program that does not expect it stops, as after any Ctrl-C.

    Attributes:
        done: of `simulate` a `Trajectory`, of `stream` a `StoredTrajectory`, of `check` a `Report`, of an ensemble the `Ensemble`, of a
            study its table of rows, of a mapping over tasks the list of results with None for tasks that were not done.
        number, total: macro steps, tasks or rows that were done, and those asked for; `total` is None where it is not known before.
        units: "macro steps", "cases", "chunks", "runs".
    """

    def __init__(self, done, number: int, total: int | None, units: str, advice: str = ""):
        self.done, self.number, self.total, self.units, self.advice = done, number, total, units, advice
        count = f"{number} {units}" if total is None else f"{number} of {total} {units}"
        super().__init__(f"interrupted after {count}; {advice or 'this exception has them in .done'}.")

    def __reduce__(self):
        return type(self), (self.done, self.number, self.total, self.units, self.advice)


@contextmanager
def interrupts_noted() -> Iterator[Callable[[], bool]]:
    """Within, a first Ctrl-C is only noted and a second one raises; yields the function that says whether there was one.

    Where Python allows no handlers (outside the main thread), or somebody else handles Ctrl-C, nothing changes.
    """
    own = signal.default_int_handler
    active = threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) is own
    noted = []

    def note(number, frame) -> None:
        noted.append(number)
        signal.signal(signal.SIGINT, own)

    if active:
        signal.signal(signal.SIGINT, note)
    try:
        yield lambda: bool(noted)
    finally:
        if active:
            signal.signal(signal.SIGINT, own)

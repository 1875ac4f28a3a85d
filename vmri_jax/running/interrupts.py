"""Ctrl-C in a long run: the piece at work is finished, nothing computed is lost."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class Interrupted(KeyboardInterrupt):
    """A run was stopped by Ctrl-C; what was computed before is in `.trajectory`.

    A `KeyboardInterrupt`: a program that does not expect it stops, as after any Ctrl-C.

    Attributes:
        trajectory: the `Trajectory` up to there; of `stream` the `StoredTrajectory`.
        step, num_steps: macro steps done, and asked for.
    """

    def __init__(self, trajectory, step: int, num_steps: int):
        self.trajectory, self.step, self.num_steps = trajectory, step, num_steps
        super().__init__(
            f"interrupted after {step} of {num_steps} macro steps; what was computed is in this exception's .trajectory."
        )

    def __reduce__(self):
        return type(self), (self.trajectory, self.step, self.num_steps)


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

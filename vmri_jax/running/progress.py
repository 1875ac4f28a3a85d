"""Progress of long work: who is told, and how it is shown, as a bar in a terminal and as lines elsewhere.

Work that takes more than two seconds says by a line what it does, whether it was asked for progress or not. A thread of its own
writes the lines, so that they come while JAX compiles, too.
"""

import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import wraps
from typing import ParamSpec, TypeVar, cast

Progress = Callable[[str, int, int], None]
"""Called as ``progress(what, done, total)`` before every piece of work and once at the end."""
P = ParamSpec("P")
R = TypeVar("R")
ShowsProgress = bool | Progress
"""The argument ``progress`` of all functions that take long: True for a bar, False for a line now and then, or a function that is told."""


SECONDS = 2.0
"""Before the first line, and between two lines that tell something new; with a larger value the user waits longer in silence."""
LONGEST_SILENCE = 60.0
"""Seconds between two lines at most. Lines that tell nothing new come after twice the time of the one before; with a larger value the
log of a run that compiles for an hour has fewer lines."""
LOOKS = 0.5
"""Seconds between two looks of the thread at the work; a larger value makes lines late by as much."""


class Working:
    """Within, what is being done is said on the error stream if it takes more than two seconds.

        with Working("fit") as tell:
            tell("the Jacobian at the start", 1, 3)

    It costs about a microsecond where nothing is said. Works within each other share one line, the outermost one first.
    """

    def __init__(self, name: str, shown: bool = True):
        self.name, self.shown, self.what, self.part = name, shown, "", ""
        self.begin = self.last = time.monotonic()
        self.wait, self.said = SECONDS, ""

    def __call__(self, what: str, done: int, total: int) -> None:
        """A `Progress`: what is done now."""
        self.what, self.part = what, f"{done / total:4.0%}  " if 0 < done < total else ""

    def __enter__(self) -> Progress:
        _works.append(self)
        if not _awake.is_set():
            _wake()
        return self

    def __exit__(self, *_) -> None:
        _works.remove(self)

    def say(self, inner: Sequence["Working"], now: float) -> None:
        """A line about this and the works within it, if it is time for one."""
        works = [self, *inner]
        if not all(work.shown for work in works):
            return
        line = "; ".join(filter(None, (": ".join(filter(None, (work.name, work.what))) for work in works)))
        news = self.part + line != self.said
        if now - self.last < (SECONDS if news else self.wait):
            return
        self.wait = SECONDS if news else min(2 * self.wait, LONGEST_SILENCE)
        self.last, self.said = now, self.part + line
        print(f"{now - self.begin:5.0f} s  {self.said}", file=sys.stderr, flush=True)


_works: list[Working] = []
_awake = threading.Event()
_watchers: list[threading.Thread] = []


def _wake() -> None:
    """Have the thread look at the work; after a fork of the process there is none yet."""
    _awake.set()
    if not any(watcher.is_alive() for watcher in _watchers):
        _watchers[:] = [threading.Thread(target=_watch, name="vmri_jax progress", daemon=True)]
        _watchers[0].start()


def _watch() -> None:
    while True:
        _awake.wait()
        time.sleep(LOOKS)
        works = tuple(_works)
        if works:
            works[0].say(works[1:], time.monotonic())
        else:
            _awake.clear()
            if _works:  # begun in between
                _awake.set()


@contextmanager
def progress_shown() -> Iterator[Progress]:
    """A `Progress` that shows itself on the error stream: a bar, or a line every few seconds where that is a pipe or a file."""
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars

    console = Console(stderr=True)
    if not (console.is_terminal or console.is_jupyter):
        with Working("") as tell:
            tell("starting", 0, 1)  # else a line without words comes before the first piece of work
            yield tell
        return
    columns = BarColumn(bar_width=24), TimeElapsedColumn(), TextColumn("{task.description}")
    with Bars(*columns, console=console, transient=True) as bars, Working("", shown=False):
        task = bars.add_task("starting")
        yield lambda what, done, total: bars.update(task, description=what, completed=done, total=total)


def progress_to(name: str, progress: ShowsProgress) -> AbstractContextManager[Progress]:
    """Within, whoever asked for progress is told about the work.

    Args:
        name: of the function that works, for lines that nobody asked for.
        progress: the argument of that function.

    Raises:
        TypeError: neither True nor False nor a function.
    """
    if isinstance(progress, bool):
        return progress_shown() if progress else Working(name)
    if not callable(progress):
        raise TypeError(
            f"{name}: progress is {progress!r}; it must be True or False, or a function of (what, done, total)."
        )
    return nullcontext(progress)


def shows_progress(function: Callable[P, R]) -> Callable[P, R]:
    """`function`, which calls its argument `progress`, for users that give True or False for it, see `ShowsProgress`."""

    @wraps(function)
    def shown(*args: P.args, **kwargs: P.kwargs) -> R:
        with progress_to(function.__name__, cast(ShowsProgress, kwargs.pop("progress", False))) as tell:
            kwargs["progress"] = tell
            return function(*args, **kwargs)

    return shown


def silent(what: str, done: int, total: int) -> None:
    """A `Progress` that shows nothing."""


def part(progress: Progress, index: int, count: int, name: str = "") -> Progress:
    """Progress of part `index` of `count` equal parts of a longer work, with `name` before what it says."""

    def within(what: str, done: int, total: int) -> None:
        progress(f"{name}{what}", 1000 * index + 1000 * done // max(total, 1), 1000 * count)

    return within

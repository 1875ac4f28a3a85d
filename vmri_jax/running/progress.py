"""Progress of long work, shown as a bar in a terminal and as lines elsewhere.

Work that takes more than two seconds prints a line about its current task, even if the user did not ask for progress. A
separate thread writes the lines, so that they appear while JAX compiles, too. Lines say whether JAX is tracing or
compiling, which events of `jax.monitoring` tell; a program that is compiled has no such events, so that its calls cost
nothing.
"""

import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext

import jax.monitoring

from vmri_jax.refusals import Refused

Progress = Callable[[str, int, int], None]
"""Called as ``progress(what, done, total)`` before every piece of work and once at the end: `what` names the piece,
`done` of `total` pieces are finished."""
ShowsProgress = bool | Progress
"""The argument ``progress`` of all functions that take long: True for a bar, False for occasional lines, or a
`Progress` of the user."""
SECONDS_BETWEEN_LINES = 2.0
"""Seconds before the first line, and between two lines with different texts; with a larger value the user waits longer
in silence."""
LONGEST_SILENCE = 5.0
"""Most seconds between two lines. The wait before a line that repeats the last one doubles each time up to this value;
with a larger value a program seems to hang."""
POLL_SECONDS = 0.5
"""Seconds between two checks of the thread; a larger value delays every line by as much."""
STAGES = {
    "/jax/core/compile/jaxpr_trace_duration": "tracing",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "compiling",
    "/jax/core/compile/backend_compile_duration": "compiling",
}
"""Work of JAX on a program, by the events that `jax.monitoring` records at its begin (as a scalar) and at its end
(as a duration)."""


class Working:
    """Context that prints its current task on the error stream if the work takes more than two seconds.

        with Working("fit") as tell:
            tell("the Jacobian at the start", 1, 3)

    Short work costs about a microsecond. Nested contexts share one line, the outermost name first, if all are `shown`.
    `running` is the kind of work while JAX neither traces nor compiles.
    """

    def __init__(self, name: str, shown: bool = True, running: str = ""):
        self.name, self.shown, self.running, self.task, self.percent = name, shown, running, "", ""
        self.begin = self.last = time.monotonic()
        self.wait, self.printed = SECONDS_BETWEEN_LINES, ""

    def __call__(self, what: str, done: int, total: int) -> None:
        """A `Progress`: notes the current task for the next line."""
        self.task, self.percent = what, f"{done / total:4.0%}  " if 0 < done < total else ""

    def __enter__(self) -> Progress:
        _works.append(self)
        if not _awake.is_set():
            _wake()
        return self

    def __exit__(self, *_) -> None:
        _works.remove(self)

    def print_line(self, inner: Sequence["Working"], now: float) -> None:
        """Print a line about this context and the contexts within it, if enough time has passed since the last line."""
        works = [self, *inner]
        if not all(work.shown for work in works):
            return
        tasks = "; ".join(filter(None, (": ".join(filter(None, (work.name, work.task))) for work in works)))
        stage = _stages[-1] if _stages else works[-1].running
        line = self.percent + tasks + (f" ({stage})" if stage else "")
        is_new = line != self.printed
        if now - self.last < (SECONDS_BETWEEN_LINES if is_new else self.wait):
            return
        self.wait = SECONDS_BETWEEN_LINES if is_new else min(2 * self.wait, LONGEST_SILENCE)
        self.last, self.printed = now, line
        print(f"{now - self.begin:5.0f} s  {line}", file=sys.stderr, flush=True)


_works: list[Working] = []
_stages: list[str] = []
_awake = threading.Event()
_watchers: list[threading.Thread] = []


def _wake() -> None:
    """Wake the thread that prints, and start it if there is none, as at first use and after a fork of the process."""
    _awake.set()
    if not _watchers:
        jax.monitoring.register_scalar_listener(_stage_begins)
        jax.monitoring.register_event_duration_secs_listener(_stage_ends)
    if not any(watcher.is_alive() for watcher in _watchers):
        _watchers[:] = [threading.Thread(target=_watch, name="vmri_jax progress", daemon=True)]
        _watchers[0].start()


def _stage_begins(event: str, *_, **__) -> None:
    if event in STAGES:
        _stages.append(STAGES[event])


def _stage_ends(event: str, *_, **__) -> None:
    if event in STAGES and _stages:
        _stages.pop()


def _watch() -> None:
    while True:
        _awake.wait()
        time.sleep(POLL_SECONDS)
        works = tuple(_works)
        if works:
            works[0].print_line(works[1:], time.monotonic())
        else:
            _awake.clear()
            if _works:  # work that began before `clear` found the event still set and did not wake the thread
                _awake.set()


@contextmanager
def progress_shown() -> Iterator[Progress]:
    """A `Progress` that shows itself on the error stream: a bar, or a line every few seconds where that is a pipe or a
    file."""
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars

    console = Console(stderr=True)
    if not (console.is_terminal or console.is_jupyter):
        with Working("") as tell:
            tell("starting", 0, 1)  # else the line before the first piece of work would be empty
            yield tell
        return
    columns = BarColumn(bar_width=24), TimeElapsedColumn(), TextColumn("{task.description}")
    with Bars(*columns, console=console, transient=True) as bars, Working("", shown=False):
        task = bars.add_task("starting")
        yield lambda what, done, total: bars.update(task, description=what, completed=done, total=total)


def progress_to(name: str, progress: ShowsProgress) -> AbstractContextManager[Progress]:
    """Context that yields the `Progress` for the argument `progress` of the function of this name."""
    check_progress(name, progress)
    if callable(progress):
        return nullcontext(progress)
    return progress_shown() if progress else Working(name)


def check_progress(name: str, progress: ShowsProgress) -> None:
    """Refuse an argument `progress` of the function of this name that is neither True nor False nor a function."""
    if not (isinstance(progress, bool) or callable(progress)):
        raise Refused(f"{name}: progress is {progress!r}; give True, False, or a function of (what, done, total).")


def silent(what: str, done: int, total: int) -> None:
    """A `Progress` that shows nothing."""


def part(progress: Progress, index: int, count: int, name: str = "") -> Progress:
    """Progress of part `index` of `count` equal parts of longer work; `name` is put before each task."""

    def within(what: str, done: int, total: int) -> None:
        progress(f"{name}{what}", 1000 * index + 1000 * done // max(total, 1), 1000 * count)

    return within

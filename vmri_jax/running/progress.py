"""Progress of long work: who is told, and how it is shown, as a bar in a terminal and as lines elsewhere."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Progress = Callable[[str, int, int], None]
"""Called as ``progress(what, done, total)`` before every piece of work and once at the end."""


SECONDS = 2.0
"""Between two lines, where the output is no terminal; what takes less shows none."""


@contextmanager
def progress_shown() -> Iterator[Progress]:
    """A `Progress` that shows itself on the error stream: a bar, or a line every few seconds where that is a pipe or a file."""
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars

    console = Console(stderr=True)
    if not (console.is_terminal or console.is_jupyter):
        yield _lines()
        return
    columns = BarColumn(bar_width=24), TimeElapsedColumn(), TextColumn("{task.description}")
    with Bars(*columns, console=console, transient=True) as bars:
        task = bars.add_task("starting")
        yield lambda what, done, total: bars.update(task, description=what, completed=done, total=total)


def _lines() -> Progress:
    begin = last = time.monotonic()

    def tell(what: str, done: int, total: int) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= SECONDS and done < total:
            last = now
            print(f"{now - begin:5.0f} s {done / total:4.0%}  {what}", file=sys.stderr, flush=True)

    return tell


def silent(what: str, done: int, total: int) -> None:
    """A `Progress` that shows nothing."""


def part(progress: Progress, index: int, count: int, name: str = "") -> Progress:
    """Progress of part `index` of `count` equal parts of a longer work, with `name` before what it says."""

    def within(what: str, done: int, total: int) -> None:
        progress(f"{name}{what}", 1000 * index + 1000 * done // max(total, 1), 1000 * count)

    return within

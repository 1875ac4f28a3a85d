"""Who listens to the progress of a long work."""

from collections.abc import Callable

Progress = Callable[[str, int, int], None]
"""Called as ``progress(what, done, total)`` before every piece of work and once at the end."""


def silent(what: str, done: int, total: int) -> None:
    """A `Progress` that shows nothing."""


def part(progress: Progress, index: int, count: int, name: str = "") -> Progress:
    """Progress of part `index` of `count` equal parts of a longer work, with `name` before what it says."""

    def within(what: str, done: int, total: int) -> None:
        progress(f"{name}{what}", 1000 * index + 1000 * done // max(total, 1), 1000 * count)

    return within

"""Small helpers that both studies share: rows to CSV, and who listens to progress."""

import csv
import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

Progress = Callable[[str, int, int], None]
"""Called as ``progress(what, done, total)`` before every piece of work and once at the end."""


def silent(what: str, done: int, total: int) -> None:
    """A `Progress` that shows nothing."""


def part(progress: Progress, index: int, count: int, name: str = "") -> Progress:
    """Progress of part `index` of `count` equal parts of a longer work, with `name` before what it says."""

    def within(what: str, done: int, total: int) -> None:
        progress(f"{name}{what}", 1000 * index + 1000 * done // max(total, 1), 1000 * count)

    return within


def write_csv(path: str | Path, rows: Sequence[Any]) -> None:
    """Write rows (dataclasses of one type) as a CSV file, one column per field."""
    names = [field.name for field in dataclasses.fields(rows[0])]
    with open(path, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(names)
        writer.writerows([getattr(row, name) for name in names] for row in rows)

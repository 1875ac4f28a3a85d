"""Result tables: the base class of results with rows, of studies, stability maps and checks."""

import csv
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from vmri_jax.running.export import extra
from vmri_jax.running.interrupts import Interrupted
from vmri_jax.running.printed import PrintedTable


@dataclass(frozen=True)
class Column:
    """A column of a printed table: its heading, the function that gives the text of a row, and whether it is flush right."""

    name: str
    text: Callable[[Any], str | Text]
    right: bool = False


class ResultTable:
    """Rows that can be shown, and written as CSV, JSON and Markdown.

    A subclass is a frozen dataclass with a field `rows`, whose items are dataclasses, and with the `columns` of the printed
    table; a column that is empty in all rows is left out. Files hold every field of every row.
    """

    rows: Any
    columns: ClassVar[tuple[Column, ...]]

    @property
    def caption(self) -> str:
        """The text below the printed table."""
        return ""

    def shown(self) -> Sequence[Any]:
        """The items that `table` and `markdown` print, one per line: the rows, unless a subclass chooses among them."""
        return self.rows

    def records(self) -> list[dict[str, Any]]:
        """The rows as dictionaries of plain values."""
        return [asdict(row) for row in self.rows]

    def lines(self) -> list[dict[str, Any]]:
        """The lines of the CSV file: the records, unless a subclass writes several lines per row."""
        return self.records()

    def to_pandas(self):
        """The lines of the CSV file as a `pandas.DataFrame`; needs the extra ``vmri_jax[xarray]``, which brings pandas."""
        return extra("pandas", "to_pandas").DataFrame(self.lines())

    def content(self) -> dict[str, Any]:
        """The content of the JSON file: the rows; a subclass adds its further fields."""
        return {"rows": self.records()}

    def table(self) -> Table:
        """A table for the terminal and for notebooks."""
        return rich_table(self.columns, self.shown(), self.caption)

    def __rich__(self) -> Table:
        return self.table()

    def __init_subclass__(cls, **options):
        super().__init_subclass__(**options)
        cls.__repr__ = ResultTable.__repr__  # else `dataclass` writes one that prints every field of every row

    def __str__(self) -> str:
        return str(self.table())

    def __repr__(self) -> str:
        return str(self)

    def _repr_mimebundle_(self, include=(), exclude=(), **kwargs) -> dict[str, str]:
        """The representation in notebooks: the table."""
        return self.table()._repr_mimebundle_(include, exclude, **kwargs)

    def markdown(self) -> str:
        """The table in Markdown."""
        columns, cells = _filled(self.columns, self.shown())
        body = [[str(cell).replace("|", "\\|").replace("\n", " ") for cell in line] for line in cells]
        head = [column.name for column in columns]
        rule = ["---:" if column.right else "---" for column in columns]
        return "".join(f"| {' | '.join(line)} |\n" for line in (head, rule, *body))

    def to_csv(self, path: str | Path) -> None:
        """Write a CSV file."""
        lines = self.lines()
        names = list(dict.fromkeys(name for line in lines for name in line))
        with open(path, "w", newline="") as file:
            writer = csv.DictWriter(file, names)
            writer.writeheader()
            writer.writerows(lines)

    def to_json(self, path: str | Path) -> None:
        """Write a JSON file. NaN becomes null, infinite numbers become "inf" and "-inf"."""
        Path(path).write_text(json.dumps(_plain(self.content()), indent=1))


@contextmanager
def interruptible(rows: Callable[[], ResultTable]) -> Iterator[None]:
    """Within this context Ctrl-C raises `Interrupted`, which carries the rows so far."""
    try:
        yield
    except KeyboardInterrupt:
        done = rows()
        raise Interrupted(done, len(done.rows), None, "runs") from None


def rich_table(columns: Sequence[Column], rows: Sequence[Any], caption: str = "", ruled: bool = False) -> Table:
    """Rows as a `rich.table.Table`, with lines between the rows if `ruled`."""
    columns, cells = _filled(columns, rows)
    table = PrintedTable(header_style="bold", caption=caption or None, show_lines=ruled)
    if not ruled:
        table.box, table.pad_edge = None, False
    for column in columns:
        table.add_column(column.name, justify="right" if column.right else "left")
    for line in cells:
        table.add_row(*(escape(cell) if isinstance(cell, str) else cell for cell in line))
    return table


def _filled(columns: Sequence[Column], rows: Sequence[Any]) -> tuple[list[Column], list[list[str | Text]]]:
    """The columns that are not empty in all rows, and the cells of each row."""
    cells = [[column.text(row) for column in columns] for row in rows]
    kept = [i for i in range(len(columns)) if not cells or any(str(line[i]) for line in cells)]
    return [columns[i] for i in kept], [[line[i] for i in kept] for line in cells]


def _plain(value: Any) -> Any:
    """The value in types that JSON knows: NaN becomes None, infinite numbers become strings, arrays become lists."""
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else str(value)
    return value

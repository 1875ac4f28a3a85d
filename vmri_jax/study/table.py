"""Result tables: the base class of results with rows, of studies, stability maps and checks."""

import csv
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar

from rich.box import HEAVY_HEAD
from rich.markup import escape
from rich.text import Text

from vmri_jax.running.export import extra
from vmri_jax.running.interrupts import Interrupted
from vmri_jax.running.printed import PrintedTable


@dataclass(frozen=True)
class Column:
    """A column of a printed table: its heading, the function that gives the text of a row, and whether it is flush
    right."""

    name: str
    text: Callable[[Any], str | Text]
    right: bool = False


class ResultTable:
    """Rows that can be printed, written to a CSV file, and handed to pandas.

    A subclass is a frozen dataclass without a ``__repr__`` of its own, with a field `rows`, whose items are
    dataclasses, and with the `columns` of the printed table, but for empty ones. Files hold every field of every row.
    """

    rows: Any
    columns: ClassVar[tuple[Column, ...]]
    ruled: ClassVar[bool] = False
    """Whether the printed table has lines between its rows."""

    @property
    def caption(self) -> str:
        """The text below the printed table."""
        return ""

    def shown(self) -> Sequence[Any]:
        """The items that `table` prints, one per line: the rows, unless a subclass chooses among them."""
        return self.rows

    def records(self) -> list[dict[str, Any]]:
        """The rows as dictionaries of plain values."""
        return [asdict(row) for row in self.rows]

    def to_pandas(self):
        """The records as a `pandas.DataFrame`; needs the extra ``vmri_jax[xarray]``, which brings pandas."""
        return extra("pandas", "to_pandas").DataFrame(self.records())

    def table(self) -> PrintedTable:
        """A table for the terminal and for notebooks, of the columns that are not empty in all lines."""
        cells = [[column.text(row) for column in self.columns] for row in self.shown()]
        kept = [i for i in range(len(self.columns)) if not cells or any(str(line[i]) for line in cells)]
        look = {"show_lines": True, "box": HEAVY_HEAD, "pad_edge": True} if self.ruled else {}
        table = PrintedTable(header_style="bold", caption=self.caption or None, **look)
        for i in kept:
            table.add_column(self.columns[i].name, justify="right" if self.columns[i].right else "left")
        for line in cells:
            shown = [line[i] for i in kept]
            table.add_row(*(escape(cell) if isinstance(cell, str) else cell for cell in shown))
        return table

    def __rich__(self) -> PrintedTable:
        return self.table()

    def __str__(self) -> str:
        return str(self.table())

    def __repr__(self) -> str:
        return str(self)

    def _repr_mimebundle_(self, include=(), exclude=(), **kwargs) -> dict[str, str]:
        """The representation in notebooks: the table."""
        return self.table()._repr_mimebundle_(include, exclude, **kwargs)

    def to_csv(self, path: str | Path) -> None:
        """Write the records to a CSV file."""
        records = self.records()
        names = list(dict.fromkeys(name for record in records for name in record))
        with open(path, "w", newline="") as file:
            writer = csv.DictWriter(file, names)
            writer.writeheader()
            writer.writerows(records)


@contextmanager
def interruptible(rows: Callable[[], ResultTable]) -> Iterator[None]:
    """Within this context Ctrl-C raises `Interrupted`, which carries the rows so far."""
    try:
        yield
    except KeyboardInterrupt:
        done = rows()
        raise Interrupted(done, len(done.rows), None, "runs") from None

"""What `print` shows: tables, and the console that all of them are printed on."""

import os

from rich.console import Console, ConsoleDimensions, ConsoleOptions, RenderResult
from rich.table import Table
from rich.text import Text

PIPE_COLUMNS = 1000
"""Characters in a line of a pipe or a file: wider than any table, so that no cell is broken into several lines."""


class OutputConsole(Console):
    """A console of rich that keeps wide tables whole where its output is a pipe or a file.

    In a terminal and in a notebook it has their width. The variable COLUMNS of the environment is obeyed everywhere.
    """

    @property
    def size(self) -> ConsoleDimensions:
        size = super().size
        if self.is_terminal or self.is_jupyter or os.environ.get("COLUMNS", "").isdigit():
            return size
        return ConsoleDimensions(PIPE_COLUMNS, size.height)


class PrintedTable(Table):
    """A table of rich that `print` shows as well; its caption has the width of the console, not that of the table."""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        caption, self.caption = self.caption, None
        try:
            yield from super().__rich_console__(console, options)
        finally:
            self.caption = caption
        if caption is not None:
            yield caption if isinstance(caption, Text) else Text(str(caption), style="italic")

    def __str__(self) -> str:
        console = OutputConsole(color_system=None)
        with console.capture() as printed:
            console.print(self)
        return "\n".join(line.rstrip() for line in printed.get().rstrip().splitlines())

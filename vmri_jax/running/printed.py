"""Printed tables, and the console that prints them."""

import os
from typing import Any

from rich.box import Box
from rich.console import Console, ConsoleDimensions, ConsoleOptions, RenderResult
from rich.table import Table
from rich.text import Text

SENTENCE_COLUMNS = 120
"""Characters in a line of a table with lines between its rows, whose cells are sentences.

Longer lines are hard to read.
"""
PIPE_COLUMNS = 1000
"""Characters in a line of a pipe or a file.

It is wider than any table, so that no cell is broken into lines; a larger value changes nothing.
"""


class OutputConsole(Console):
    """A console of rich that keeps wide tables whole where its output is a pipe or a file.

    In a terminal or a notebook it takes their width. The environment variable COLUMNS overrides both.
    """

    @property
    def size(self) -> ConsoleDimensions:
        size = super().size
        if self.is_terminal or self.is_jupyter or os.environ.get("COLUMNS", "").isdigit():
            return size
        return ConsoleDimensions(PIPE_COLUMNS, size.height)


class PrintedTable(Table):
    """A table of rich that the built-in `print` shows, too; its caption takes the width of the console, not of the
    table."""

    def __init__(self, *headers: str, box: Box | None = None, pad_edge: bool = False, **look: Any):
        super().__init__(*headers, box=box, pad_edge=pad_edge, **look)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        caption, self.caption = self.caption, None
        if self.show_lines:
            options = options.update(max_width=min(options.max_width, SENTENCE_COLUMNS))
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

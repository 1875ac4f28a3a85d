"""Tables that `print` shows."""

from rich.console import Console
from rich.table import Table


class PrintedTable(Table):
    """A table of rich that `print` shows as well."""

    def __str__(self) -> str:
        console = Console(color_system=None)
        with console.capture() as printed:
            console.print(self)
        return printed.get().rstrip()

"""Parts of all commands: options, the console, refusals, failures and Ctrl-C, tables, checks of files to write."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.panel import Panel
from rich.text import Text
from typer import Argument, Option

from vmri_jax.refusals import NotInstalled, Refused
from vmri_jax.running.files import check_writable, make_writable_folder
from vmri_jax.running.interrupts import Interrupted
from vmri_jax.running.printed import OutputConsole, PrintedTable

console = OutputConsole()

PICTURES = (".png", ".svg", ".pdf")
"""Endings of files of figures."""

System = Annotated[str, Argument(help="fpu, tsp, sam, my_file.py:my_problem, or my_file.py alone.")]
MacroStep = Annotated[float | None, Option(help="Macro step H, of num_micro micro steps.")]
Scheme = Annotated[str, Option(help="See [bold]vmri schemes[/bold].")]
NumMicro = Annotated[int, Option(help="Micro steps per macro step.")]
Alpha = Annotated[
    float | None, Option(help="Part of each kick at the start of a step, explicit schemes. [dim]default: 0.5[/dim]")
]
Degree = Annotated[int | None, Option(help="Degree of the path of galerkin.")]
Rule = Annotated[str | None, Option(help="Nodes of galerkin: gauss or lobatto. [dim]default: gauss[/dim]")]
Compose = Annotated[str | None, Option(help="Compose the scheme to a higher order, e.g. suzuki4, kahan-li8.")]


class BadInput(typer.BadParameter):
    """A wrong argument: its message is shown in a panel, exit code 2."""

    def format_message(self) -> str:
        return as_options(self.message)


def as_options(text: str) -> str:
    """The text of a message of the library with options of the command in place of arguments of Python."""
    return text.replace("resume=True", "--resume").replace("overwrite=True", "--overwrite")


FAULT = "This is no error of your command, but of the program. Please report it, with the command and the lines below."


@contextmanager
def refusals() -> Iterator[None]:
    """Within this context refusals and Ctrl-C are shown as panels, other errors of classes of refusals as faults."""
    try:
        yield
    except Interrupted as stopped:
        count = stopped.number if stopped.total is None else f"{stopped.number} of {stopped.total}"
        advice = f"; {stopped.advice}" if stopped.advice else ""
        raise print_failure("Interrupted", f"After {count} {stopped.units}{advice}.", 130) from stopped
    except Refused as error:
        raise BadInput(str(error)) from error
    except NotInstalled as error:
        raise print_failure("Not installed", str(error)) from error
    except (ValueError, TypeError, ImportError):
        print_failure("A fault inside", FAULT)
        raise
    except (FileExistsError, FileNotFoundError) as error:
        raise BadInput(str(error)) from error
    except OSError as error:
        raise print_failure("Not written", error.strerror or str(error)) from error


def print_failure(title: str, text: str, code: int = 1) -> typer.Exit:
    """Print a red panel on the error stream; returns the exit with this code, to be raised."""
    Console(stderr=True).print(Panel(Text(as_options(text)), title=title, title_align="left", border_style="red"))
    return typer.Exit(code)


def print_written(title: str, path: Path | None) -> None:
    """Print the path of a written file, if there is one."""
    if path is not None:
        console.print(f"{title}: [bold]{escape(str(path))}[/bold]", soft_wrap=True)


def print_named(texts: dict[str, str]) -> None:
    """Print a line for each name and its text; empty texts are left out."""
    table = PrintedTable("", "", show_header=False)
    for name, text in texts.items():
        if text:
            table.add_row(f"[dim]{name}[/dim]", escape(text))
    console.print(table)


def check_target(option: str, path: Path | None, *endings: str) -> None:
    """Refuse a file that cannot be written, or has another ending; without endings make a folder, or refuse it."""
    if path is None:
        return
    if endings and path.suffix.lower() not in endings:
        raise Refused(f"{option} {path}: the file must end in {' or '.join(endings)}.")
    try:
        (check_writable if endings else make_writable_folder)(path)
    except OSError as error:
        raise Refused(f"{option} {error.strerror or error}") from error

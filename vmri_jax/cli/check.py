"""The command ``vmri hard``: run the hard cases on the built-in systems, or on one of your own."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from vmri_jax.cli.catalogue import find_problem
from vmri_jax.hard import cases_for, catalogue, run_cases


def hard(
    case: Annotated[list[int] | None, typer.Option(help="Number of a case; again for more of them.")] = None,
    full: Annotated[bool, typer.Option(help="Full forms: runs of up to a million steps, minutes.")] = False,
    system: Annotated[
        str | None, typer.Option(help="The cases that make sense for a system, e.g. my_file.py:my_problem.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for tables (md, csv, json) and pictures.")] = None,
) -> None:
    """Hard cases: resonances, large and tiny steps, constraints under stress, contact, long runs, bad input.

    Ends with code 1 if a criterion is not met.
    """
    console = Console()
    try:
        cases = catalogue() if system is None else cases_for(find_problem(system))
        with Progress(
            TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=console, transient=True
        ) as bar:
            task = bar.add_task("hard cases")

            def tell(what: str, done: int, total: int) -> None:
                bar.update(task, description=what, completed=done, total=total)

            report = run_cases(case, full, tell, cases)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
    console.print(report.table())
    missed = [str(row.case.number) for row in report.rows if not row.outcome.passed]
    console.print(
        f"{len(report.rows) - len(missed)} of {len(report.rows)} criteria met{'; missed: ' * bool(missed)}{', '.join(missed)}"
    )
    if out is not None:
        for path in report.write(out):
            console.print(f"wrote {path}")
    if missed:
        raise typer.Exit(1)

"""`vmri check`: hard cases that make sense for any system, applied to a system of the user."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from vmri_jax.catalogue import find_problem
from vmri_jax.cli import common
from vmri_jax.cli.common import check_target, console
from vmri_jax.hard_cases import Case, cases_for, run_cases
from vmri_jax.running.interrupts import Interrupted
from vmri_jax.running.progress import progress_shown

Numbers = Annotated[list[int] | None, typer.Option("--case", help="Number of a case; may be repeated.")]
Full = Annotated[bool, typer.Option("--full", help="Full forms: runs of up to a million steps, minutes.")]
Out = Annotated[Path | None, typer.Option(help="Folder for a table, cases.csv, and pictures.")]


def check(system: common.System, case: Numbers = None, full: Full = False, out: Out = None) -> None:
    """Put a system to the hard cases: constraints, energy, tolerance, tiny steps, reversal, batches, bad input.

    Steps are chosen from its frequencies. Cases that do not apply say why. Ends with code 1 if a criterion is not met.
    """
    check_target("--out", out)
    cases = cases_for(find_problem(system))
    run_and_show(cases, case or (), full, out)


def run_and_show(cases: Sequence[Case], numbers: Sequence[int], full: bool, out: Path | None) -> None:
    """Run cases, show and write their results; exit code 1: a missed criterion, 2: a wrong number, 130: Ctrl-C."""
    stopped = None
    with progress_shown() as tell:
        try:
            report = run_cases(cases, numbers, full, tell)
        except Interrupted as interrupted:
            report, stopped = interrupted.done, interrupted
    console.print(report.table())
    judged, missed = [row for row in report.rows if row.passed is not None], report.missed
    console.print(f"{len(judged) - len(missed)} of {len(judged)} criteria met")
    if missed:
        console.print(f"missed: {', '.join(str(row.case.number) for row in missed)}")
    if out is not None:
        for path in report.write(out):
            console.print(f"wrote {path}", soft_wrap=True)
    if stopped is not None:
        raise stopped
    if missed:
        raise typer.Exit(1)

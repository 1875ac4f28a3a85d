"""`python -m benchmarks gail2014`: the reference study, figure by figure."""

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from benchmarks.gail2014.reference import reference_figures
from benchmarks.gail2014.report import FigureResult, choose_figures, reproduce
from benchmarks.measure import prepare
from vmri_jax.cli.common import check_target, console, print_failure
from vmri_jax.running.progress import progress_shown


def gail2014(
    full: Annotated[
        bool, typer.Option("--full/--quick", help="The lists of the paper (an hour), or few values.")
    ] = False,
    only: Annotated[list[str] | None, typer.Option(help="Only this figure, e.g. fig6; may be repeated.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for figures, tables and the report.")] = Path("out"),
) -> None:
    """Run the reference study of Gail et al. (2014): figures, tables and out/report.html."""
    prepare()
    size = "full" if full else "quick"
    choose_figures(reference_figures(size), only or [])
    check_target("--out", out)
    with progress_shown() as show:
        report = reproduce(out, size, only or [], show, _figure_done)
    console.print("\n" + escape("\n".join(report.in_five_lines())), soft_wrap=True)
    if report.failed:
        reasons = "\n".join(f"{figure.name}: {figure.error}" for figure in report.failed)
        print_failure("Figures that failed", reasons)
        raise typer.Exit(1)


def _figure_done(result: FigureResult) -> None:
    agreeing = f"{sum(check.agrees for check in result.checks)} of {len(result.checks)}"
    mark = "[red]failed[/red]" if result.error else agreeing
    console.print(f"{result.name:<11} {mark}  {result.title}  [dim]{result.seconds:.0f} s[/dim]")

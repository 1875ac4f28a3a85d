"""`python -m benchmarks gail2014`: the reference study, figure by figure."""

import gc
import os
from pathlib import Path
from typing import Annotated

import jax
import typer
from rich.markup import escape

from benchmarks.gail2014.reference import reference_figures
from benchmarks.gail2014.report import FigureResult, choose_figures, reproduce
from benchmarks.measure import prepare
from vmri_jax.cli.common import BadInput, console, print_failure
from vmri_jax.running.progress import progress_shown

QUICK_FLAGS = "--xla_cpu_parallel_codegen_split_count=1 --xla_disable_hlo_passes=dot-library-rewriter,while-loop-invariant-code-motion,simplify-while-loops"
"""Options of XLA for programs that compile for seconds and run for milliseconds: one module, not copies of its parts, and no passes over loops that
only make them faster."""
OBJECTS_UNTIL_COLLECTION = 50_000
"""Objects that Python makes between collections of garbage, 700 by default. Tracing makes many that live; a larger value keeps garbage for longer."""


def start(size: str) -> None:
    """The settings of JAX. The quick study compiles without optimisations, in a third of the time; orders and shapes of curves stay."""
    if size == "quick":
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {QUICK_FLAGS}".strip()
        jax.config.update("jax_disable_most_optimizations", True)
        # no places in Python's code in programs that nobody reads
        jax.config.update("jax_traceback_in_locations_limit", 0)
        gc.set_threshold(OBJECTS_UNTIL_COLLECTION, 20, 20)
    prepare()


def gail2014(
    full: Annotated[
        bool, typer.Option("--full/--quick", help="The lists of the paper (an hour), or few values.")
    ] = False,
    only: Annotated[list[str] | None, typer.Option(help="Only this figure, e.g. fig6; may be repeated.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for figures, tables and the report.")] = Path("out"),
) -> None:
    """Run the reference study of Gail et al. (2014): figures, tables and out/report.html."""
    size = "full" if full else "quick"
    start(size)
    try:
        choose_figures(reference_figures(size), only or [])
        out.mkdir(parents=True, exist_ok=True)
    except ValueError as error:
        raise BadInput(str(error)) from error
    except OSError as error:
        raise BadInput(f"--out {out}: {error.strerror}; give a folder that can be written.") from error
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

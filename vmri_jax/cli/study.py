"""`vmri tune` and `vmri cost`: the least time of runs with a given error."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

from rich.markup import escape
from typer import Option

from vmri_jax import study
from vmri_jax.catalogue import find_problem
from vmri_jax.cli import common
from vmri_jax.cli.common import check_target, console, print_failure, print_written
from vmri_jax.running.interrupts import Interrupted
from vmri_jax.steppers.results import SimulationError
from vmri_jax.study.table import ResultTable
from vmri_jax.study.tuning import PERIODS, NothingReached


def tune(
    system: common.System,
    error: Annotated[float, Option(help="Largest accepted error of a position in the run, in its unit.")],
    t_end: Annotated[float, Option(help="Simulated time.")],
    exhaustive: Annotated[bool, Option("--exhaustive", help="Search without shortcuts.")] = False,
    out: Annotated[Path | None, Option(help="Write all runs of the search here, .csv.")] = None,
) -> None:
    """Find the scheme, num_micro and macro step that reach an error in the least time on this machine.

    Examples:

    vmri tune fpu --error 1e-4 --t-end 10

    vmri tune my_file.py:my_problem --error 1e-3 --t-end 2
    """
    check_target("--out", out, ".csv")
    problem = find_problem(system)
    try:
        with _search(out):
            choice = study.tune(problem, error, t_end, exhaustive=exhaustive, progress=True)
    except NothingReached as failure:
        console.print(failure.runs.table())
        _write_runs(failure.runs, out)
        raise print_failure("Nothing reached the error", f"{failure} The best runs are above.") from failure
    console.print("[bold]Errors against time[/bold], the best of all runs\n", choice.runs.table(), "\n", choice.table())
    command = f"{choice.setting.settings.command(system)} --out run.npz"
    console.print(f"\n[bold]{escape(command)}[/bold]", soft_wrap=True)
    _write_runs(choice.runs, out)


def cost(
    system: common.System,
    t_end: Annotated[
        float | None, Option(help=f"Simulated time. [dim]default: {PERIODS} fastest periods[/dim]")
    ] = None,
    error: Annotated[
        list[float] | None, Option(help="May be repeated. [dim]default: 1e-2 to 1e-8 of the motion[/dim]")
    ] = None,
    out: Annotated[Path, Option(help="Folder for the page.")] = Path("out/cost"),
) -> None:
    """Write a page about the cost of accuracy: time over error, and the best scheme for each error.

    Examples:

    vmri cost tsp --out out/tsp

    vmri cost my_file.py:my_problem --t-end 5
    """
    problem = find_problem(system)
    check_target("--out", out)
    with _search(None):
        report = study.cost_report(problem, system, out, t_end=t_end, errors=error, progress=True)
    console.print(report.table())
    print_written("\nPage", report.path)


@contextmanager
def _search(out: Path | None) -> Iterator[None]:
    """A panel if all runs of a search fail; after Ctrl-C the runs, also in `out`."""
    try:
        yield
    except SimulationError as failure:
        raise print_failure("All runs failed", str(failure)) from failure
    except Interrupted as stopped:
        console.print(stopped.done.table())
        _write_runs(stopped.done, out)
        raise


def _write_runs(runs: ResultTable, out: Path | None) -> None:
    if out is not None:
        runs.to_csv(out)

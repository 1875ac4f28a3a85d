"""`vmri explain`, `vmri advise`, `vmri stability`, `vmri check`: whether a system, its grids and steps are right."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.markup import escape
from typer import Argument, Option

from vmri_jax import plots
from vmri_jax.catalogue import find_problem, find_scene_or_problem, find_scheme
from vmri_jax.cli import common
from vmri_jax.cli.common import PICTURES, check_target, console, print_written
from vmri_jax.hard_cases import Case, cases_for, run_cases
from vmri_jax.mechanics.linearisation import linearise
from vmri_jax.mechanics.state import Problem
from vmri_jax.running.arguments import nothing_fast
from vmri_jax.running.interrupts import Interrupted
from vmri_jax.running.printed import PrintedTable
from vmri_jax.running.progress import Working
from vmri_jax.scene.ledger import ledger_of_functions
from vmri_jax.stability import advise as advise_on
from vmri_jax.stability import linear_model, plot_stability, stability_map
from vmri_jax.stability.drive import growth_over_period
from vmri_jax.stability.map import windows_text

Numbers = Annotated[list[int] | None, typer.Option("--case", help="Number of a case; may be repeated.")]
Full = Annotated[bool, typer.Option("--full", help="Full forms: runs of up to a million steps, minutes.")]
Out = Annotated[Path | None, typer.Option(help="Folder for a table, cases.csv, and pictures.")]


def explain(
    system: common.System,
    scheme: common.Scheme = "fully-implicit",
    num_micro: common.NumMicro = 10,
    alpha: common.Alpha = None,
    degree: common.Degree = None,
    rule: common.Rule = None,
    compose: common.Compose = None,
    macro_dt: common.MacroStep = None,
    measure: Annotated[bool, Option(help="Time a macro step, and the derivatives of every effect.")] = True,
) -> None:
    """Show the grid of every body and effect of a scene, or function of a system, why, its cost, and frequencies.

    The cost: unknowns, evaluations, and the time of one evaluation of the first derivatives at all nodes. Frequencies
    are of small vibrations about the start.

    Example:

    vmri explain my_file.py:my_scene --scheme explicit-slow --num-micro 20
    """
    chosen = find_scheme(scheme, num_micro, compose, alpha=alpha, degree=degree, rule=rule)
    moving = find_scene_or_problem(system)
    with Working("compiling and timing a macro step, and frequencies" if measure else "frequencies"):
        if isinstance(moving, Problem):
            ledger = ledger_of_functions(moving, chosen, macro_dt, measure)
        else:
            ledger = moving.explain(chosen, macro_dt=macro_dt, measure=measure)
        small = linearise(moving)
        growth = growth_over_period(moving, small)
        vibrations = str(small) if growth is None else f"{small}\n{growth}"
    console.print(ledger.table())
    console.print()
    console.print(ledger.reasons())
    console.print("\n[bold]Small vibrations[/bold] about the start, estimates where it is not at rest\n")
    console.print(escape(vibrations))
    useless = nothing_fast(chosen, sum(row.kind == "body" and row.grid != "macro" for row in ledger.rows))
    if useless:
        console.print(f"\n[yellow]{escape(useless)}[/yellow]")


def advise(
    system: common.System,
    macro_dt: Annotated[float, Option(help="Macro step H, of num_micro micro steps.")],
    scheme: common.Scheme = "fully-implicit",
    num_micro: common.NumMicro = 10,
    alpha: common.Alpha = None,
    degree: common.Degree = None,
    rule: common.Rule = None,
    compose: common.Compose = None,
) -> None:
    """Judge a step before a long run: resonances, limits, labels, and the nearest safe step.

    Exit code 1 where the step is unstable at the start of the run, or close to it.

    Examples:

    vmri advise fpu --scheme explicit-slow --num-micro 30 --macro-dt 0.0628

    vmri advise my_file.py:my_problem --macro-dt 0.02
    """
    problem = find_problem(system)
    chosen = find_scheme(scheme, num_micro, compose, alpha=alpha, degree=degree, rule=rule)
    with Working("judging this step and the steps around it"):
        advice = advise_on(problem, chosen, macro_dt=macro_dt)
    console.print(advice.table() if advice.findings else escape(advice.verdict))
    if not advice.ok:
        raise typer.Exit(1)


def stability(
    system: Annotated[
        str | None, Argument(help="A system at its start. [dim]default: a slow and a stiff spring[/dim]")
    ] = None,
    scheme: Annotated[list[str] | None, Option(help="May be repeated. [dim]default: explicit-slow[/dim]")] = None,
    num_micro: Annotated[list[int] | None, Option(help="May be repeated. [dim]default: 2 5 10 20[/dim]")] = None,
    alpha: common.Alpha = None,
    degree: common.Degree = None,
    rule: common.Rule = None,
    compose: common.Compose = None,
    until: Annotated[float, Option(help="Largest omega H, in units of pi.", min=0.1)] = 4.0,
    out: Annotated[Path | None, Option(help="Draw the map here: .png, .svg or .pdf.")] = None,
) -> None:
    """Find the stable macro steps of a scheme, in units of the fastest vibration.

    Examples:

    vmri stability --scheme explicit-slow --num-micro 2 --num-micro 5 --num-micro 10 --out map.png

    vmri stability tsp --scheme fully-explicit --scheme mollified-impulse
    """
    check_target("--out", out, *PICTURES)
    problem = linear_model() if system is None else find_problem(system)
    numbers, grid = num_micro or [2, 5, 10, 20], np.linspace(0.02, until, max(2, round(50 * until))) * np.pi
    chosen = {
        name: {n: find_scheme(name, n, compose, alpha=alpha, degree=degree, rule=rule) for n in numbers}
        for name in scheme or ["explicit-slow"]
    }
    with Working("multipliers of the steps"):
        maps = {name: stability_map(problem, schemes, grid) for name, schemes in chosen.items()}
    if out is not None:
        plots.save(plot_stability(maps, system or "one slow and one stiff spring"), out)
    table = PrintedTable("scheme", "num_micro", "unstable where omega H / pi is in")
    table.caption = next(iter(maps.values())).note or None
    for name, stability_of_scheme in maps.items():
        for n, windows in stability_of_scheme.shown():
            table.add_row(name, str(n), windows_text(windows))
    console.print(table)
    print_written("Figure", out)


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
    try:
        report = run_cases(cases, numbers, full, progress=True)
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

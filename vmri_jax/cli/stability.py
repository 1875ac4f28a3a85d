"""`vmri advise` and `vmri stability`: whether a step is stable, and all stable steps of a scheme."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.markup import escape
from typer import Argument, Option

from vmri_jax import plots
from vmri_jax.catalogue import find_problem, find_scheme
from vmri_jax.cli import options
from vmri_jax.cli.common import PICTURES, check_target, console, print_written
from vmri_jax.running.printed import PrintedTable
from vmri_jax.running.progress import Working
from vmri_jax.stability import advise as advise_on
from vmri_jax.stability import linear_model, plot_stability, stability_map
from vmri_jax.stability.map import windows_text


def advise(
    system: options.System,
    macro_dt: Annotated[float, Option(help="Macro step H, of num_micro micro steps.")],
    scheme: options.Scheme = "fully-implicit",
    num_micro: options.NumMicro = 10,
    alpha: options.Alpha = None,
    degree: options.Degree = None,
    rule: options.Rule = None,
    compose: options.Compose = None,
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
    system: Annotated[str | None, Argument(help="A system at its start. [dim]a slow and a stiff spring[/dim]")] = None,
    scheme: Annotated[list[str] | None, Option(help="May be repeated. [dim]explicit-slow[/dim]")] = None,
    num_micro: Annotated[list[int] | None, Option(help="May be repeated. [dim]2 5 10 20[/dim]")] = None,
    alpha: options.Alpha = None,
    degree: options.Degree = None,
    rule: options.Rule = None,
    compose: options.Compose = None,
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

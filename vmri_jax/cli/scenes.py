"""`vmri explain`: grid and cost of every body and effect of a scene or function of a system, and small vibrations."""

from typing import Annotated

from rich.markup import escape
from typer import Option

from vmri_jax.catalogue import find_scene_or_problem, find_scheme
from vmri_jax.cli import options
from vmri_jax.cli.common import console
from vmri_jax.mechanics.linearisation import linearise
from vmri_jax.mechanics.state import Problem
from vmri_jax.running.arguments import nothing_fast
from vmri_jax.running.progress import Working
from vmri_jax.scene.ledger import ledger_of_functions
from vmri_jax.stability.drive import growth_over_period


def explain(
    system: options.System,
    scheme: options.Scheme = "fully-implicit",
    num_micro: options.NumMicro = 10,
    alpha: options.Alpha = None,
    degree: options.Degree = None,
    rule: options.Rule = None,
    compose: options.Compose = None,
    macro_dt: options.MacroStep = None,
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

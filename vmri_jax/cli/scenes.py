"""`vmri explain`: what a scene adds to a macro step, body by body and effect by effect."""

from typing import Annotated

import typer
from rich.markup import escape

from vmri_jax.catalogue import find_scene, find_scheme
from vmri_jax.cli import options
from vmri_jax.cli.common import RIGHT, console, refusals, status
from vmri_jax.running.arguments import nothing_fast

app = typer.Typer()


@app.command(
    rich_help_panel=RIGHT, epilog="Example:\n\nvmri explain my_file.py:my_scene --scheme explicit-slow --num-micro 20"
)
def explain(
    scene: Annotated[str, typer.Argument(help="my_file.py:my_scene, or my_file.py alone.")],
    scheme: options.Scheme = "fully-implicit",
    num_micro: options.NumMicro = 10,
    alpha: options.Alpha = None,
    degree: options.Degree = None,
    rule: options.Rule = None,
    compose: options.Compose = None,
    macro_dt: Annotated[
        float | None, typer.Option(help="Macro step that is timed. [dim]from the fastest vibration[/dim]")
    ] = None,
    measure: Annotated[bool, typer.Option(help="Time a macro step, and the derivatives of every effect.")] = True,
) -> None:
    """Where every body and effect of a scene lives and why, and what it adds: unknowns, evaluations, time.

    The time of an effect is that of its first derivatives at all of its nodes, once.
    """
    with refusals():
        chosen = find_scheme(scheme, num_micro, compose, alpha=alpha, degree=degree, rule=rule)
        found = find_scene(scene)
        with status("compiling and timing" if measure else "looking"):
            ledger = found.explain(chosen, macro_dt=macro_dt, measure=measure)
    console.print(ledger.table())
    console.print()
    console.print(ledger.reasons())
    useless = nothing_fast(chosen, sum(row.kind == "body" and row.grid != "macro" for row in ledger.rows))
    if useless:
        console.print(f"\n[yellow]{escape(useless)}[/yellow]")

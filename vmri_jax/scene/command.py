"""``vmri explain``: the ledger of a scene in a file."""

from typing import Annotated

import typer
from rich.console import Console

from vmri_jax.catalogue import find_scene, find_scheme

console = Console()


def explain(
    scene: Annotated[str, typer.Argument(help="my_file.py, or my_file.py:my_scene.")],
    scheme: Annotated[str, typer.Option(help="See [bold]vmri schemes[/bold].")] = "fully-implicit",
    num_micro: Annotated[int, typer.Option(help="Micro steps per macro step.")] = 10,
    degree: Annotated[int | None, typer.Option(help="Degree of the path, galerkin.")] = None,
    compose: Annotated[str | None, typer.Option(help="Compose the scheme to a higher order.")] = None,
    macro_dt: Annotated[
        float | None,
        typer.Option(
            help="Macro step that is timed. [dim]a tenth radian of the fastest vibration per micro step[/dim]"
        ),
    ] = None,
    measure: Annotated[bool, typer.Option(help="Compile the scene without each effect in turn and time it.")] = True,
) -> None:
    """Say for every body and effect of a scene where it lives, what it adds to a macro step, and what it costs."""
    try:
        chosen = find_scheme(scheme, num_micro, compose, degree=degree)
        ledger = find_scene(scene).explain(chosen, macro_dt=macro_dt, measure=measure)
    except (ValueError, TypeError) as error:
        raise typer.BadParameter(str(error)) from error
    console.print(ledger.table())

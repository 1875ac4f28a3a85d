"""Arguments and options that several commands have: system, scheme and step."""

from typing import Annotated

import typer

System = Annotated[str, typer.Argument(help="fpu, tsp, sam, my_file.py:my_problem, or my_file.py alone.")]
MacroStep = Annotated[float | None, typer.Option(help="Macro step H, of num_micro micro steps.")]
Scheme = Annotated[str, typer.Option(help="See [bold]vmri schemes[/bold].")]
NumMicro = Annotated[int, typer.Option(help="Micro steps per macro step.")]
Alpha = Annotated[
    float | None,
    typer.Option(help="Part of each kick at the start of a step, 0 to 1, explicit schemes. [dim]0.5[/dim]"),
]
Degree = Annotated[int | None, typer.Option(help="Degree of the path, galerkin.")]
Rule = Annotated[str | None, typer.Option(help="gauss or lobatto, galerkin. [dim]gauss[/dim]")]
Compose = Annotated[str | None, typer.Option(help="Compose the scheme to a higher order, e.g. suzuki4, kahan-li8.")]

"""Arguments and options that several commands have: system, scheme and step."""

from typing import Annotated

from typer import Argument, Option

System = Annotated[str, Argument(help="fpu, tsp, sam, my_file.py:my_problem, or my_file.py alone.")]
MacroStep = Annotated[float | None, Option(help="Macro step H, of num_micro micro steps.")]
Scheme = Annotated[str, Option(help="See [bold]vmri schemes[/bold].")]
NumMicro = Annotated[int, Option(help="Micro steps per macro step.")]
Alpha = Annotated[
    float | None, Option(help="Part of each kick at the start of a step, explicit schemes. [dim]default: 0.5[/dim]")
]
Degree = Annotated[int | None, Option(help="Degree of the path of galerkin.")]
Rule = Annotated[str | None, Option(help="Nodes of galerkin: gauss or lobatto. [dim]default: gauss[/dim]")]
Compose = Annotated[str | None, Option(help="Compose the scheme to a higher order, e.g. suzuki4, kahan-li8.")]

"""`vmri systems`, `vmri schemes`, `vmri new`: what there is, and a commented file to begin with."""

from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Annotated

from rich.markup import escape
from typer import Argument, Option

from vmri_jax.catalogue import SCHEMES, SYSTEMS, options_of
from vmri_jax.cli.common import check_target, console
from vmri_jax.mechanics.summary import coordinates, parameters
from vmri_jax.running.printed import PrintedTable
from vmri_jax.schemes.composition import COMPOSITIONS


def systems() -> None:
    """List the built-in systems."""
    table = PrintedTable("name", "system", "slow", "fast", "constraints", "parameters")
    for name, make in SYSTEMS.items():
        problem = make()
        names, rows = problem.names, sum(problem.system.num_constraints(problem.q_s, problem.q_f))
        parts = coordinates(names.slow_coordinates), coordinates(names.fast_coordinates)
        numbers = f"{rows}", parameters(problem.system.params)
        table.add_row(f"[bold]{name}[/bold]", _first_sentence(make), *parts, *numbers)
    console.print(table)
    console.print("\nYour own: [bold]vmri simulate my_file.py:my_problem[/bold], a vmri_jax.Problem in that file.")


def schemes() -> None:
    """List the built-in schemes."""
    table = PrintedTable("name", "options", "scheme")
    for name, scheme in SCHEMES.items():
        options = " ".join(f"--{option}" for option in options_of(scheme))
        table.add_row(f"[bold]{name}[/bold]", options, _first_sentence(scheme))
    console.print(table)
    console.print(
        "\nOf higher order, [bold]--compose[/bold] NAME: several steps of a scheme of order 2, some backwards.\n"
    )
    table = PrintedTable("name", "order", "stages", "source")
    for name, entry in COMPOSITIONS.items():
        table.add_row(f"[bold]{name}[/bold]", f"{entry.order}", f"{len(entry.coefficients)}", entry.source)
    console.print(table)


def _first_sentence(function: Callable) -> str:
    """The first paragraph of the docstring of a system or scheme."""
    return " ".join((function.__doc__ or "").partition("\n\n")[0].replace("`", "").split())


def new(
    file: Annotated[Path, Argument(help="Where to write it: a .py, or a .toml for a sweep.")] = Path("my_system.py"),
    scene: Annotated[bool, Option("--scene", help="Bodies and effects instead of functions.")] = False,
) -> None:
    """Write a commented program that runs, to change into your own system or scene, or the file of a sweep."""
    check_target("FILE", file, ".py", ".toml")
    if file.exists():
        raise FileExistsError(f"{file} exists already; give another name.")
    if file.suffix.lower() == ".toml":
        template, commands = "sweep.toml", [f"vmri sweep {file} --workers 2"]
    else:
        kind, thing = ("scene", "scene") if scene else ("system", "problem")
        template = f"new_{kind}.py.txt"
        run = f"vmri simulate {file}:{thing} --macro-dt 0.02 --steps 200 --out run.npz"
        commands = [f"python {file}", run]
    text = files("vmri_jax.cli").joinpath(template).read_text(encoding="utf-8")
    file.write_text(text.replace("FILE", file.as_posix()), encoding="utf-8")
    console.print(f"wrote [bold]{escape(str(file))}[/bold]; run it with:", soft_wrap=True)
    for command in commands:
        console.print(f"    {escape(command)}", soft_wrap=True)

"""`vmri systems` and `vmri schemes`: lists of the built-in systems and schemes."""

from collections.abc import Callable

from vmri_jax.catalogue import SCHEMES, SYSTEMS, options_of
from vmri_jax.cli.common import console
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

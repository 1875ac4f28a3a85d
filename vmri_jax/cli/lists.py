"""`vmri systems` and `vmri schemes`: lists of the built-in systems and schemes."""

import numpy as np

from vmri_jax.catalogue import SCHEMES, SYSTEMS
from vmri_jax.cli.common import console
from vmri_jax.running.printed import PrintedTable
from vmri_jax.schemes.composition import COMPOSITIONS


def systems() -> None:
    """List the built-in systems."""
    table = PrintedTable("name", "system", "slow", "fast", "constraints", "parameters")
    for name, entry in SYSTEMS.items():
        problem = entry.factory()
        n_g, n_gs = problem.system.num_constraints(problem.q_s, problem.q_f)
        parameters = ", ".join(f"{key} = {_short(value)}" for key, value in problem.system.params.items())
        table.add_row(
            f"[bold]{name}[/bold]",
            entry.title,
            f"{problem.q_s.size}: {entry.slow}",
            f"{problem.q_f.size}: {entry.fast}",
            f"{n_g + n_gs}" if n_g + n_gs else "none",
            parameters,
        )
    console.print(table)
    console.print("\nYour own: [bold]vmri simulate my_file.py:my_problem[/bold], a vmri_jax.Problem in that file.")


def schemes() -> None:
    """List the built-in schemes."""
    table = PrintedTable("name", "order", "options", "scheme")
    for name, entry in SCHEMES.items():
        options = " ".join(f"--{option}" for option in entry.options)
        table.add_row(f"[bold]{name}[/bold]", entry.order, options, entry.title)
    console.print(table)
    console.print(
        "\nOf higher order, [bold]--compose[/bold] NAME: several steps of a scheme of order 2, some backwards.\n"
    )
    table = PrintedTable("name", "order", "stages", "source")
    for name, entry in COMPOSITIONS.items():
        table.add_row(f"[bold]{name}[/bold]", f"{entry.order}", f"{len(entry.coefficients)}", entry.source)
    console.print(table)


def _short(value) -> str:
    """A number, or a vector in brackets."""
    text = ", ".join(f"{x:g}" for x in np.ravel(value))
    return f"({text})" if np.ndim(value) else text

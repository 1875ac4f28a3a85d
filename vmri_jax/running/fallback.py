"""The fallback: what the first matrix of "auto" does not solve is solved again with exact matrices, in a program of its own.

`unsolved` decides for all runs: for a step (`macro_step`), a run or a piece of it (`vmri_jax.running.simulation`), the lanes of a batch, and runs
under transformations of JAX (`solved_again`). Names with `exact` belong to the fallback.
"""

from collections.abc import Callable
from typing import Any

import jax

from vmri_jax.steppers.results import Method, Result

FALLING_BACK = 'a step was not solved: computing its part of the run again with exact matrices (matrix "exact"), as accurate but slower'
"""Line about a fallback that takes more than two seconds."""


def unsolved(result, method):
    """Whether steps failed that exact matrices may solve.

    They cannot help explicit and linear equations, the methods up to `Method.LINEAR`, nor steps that were solved but violate implied
    constraints, `Result.NOT_IMPLIED`.

    Args:
        result: worst `Result` of the steps, of one run or (lanes,).
        method: largest `Method` of the steps.
    """
    return (result > Result.CONVERGED_AT_ROUNDOFF) & (result != Result.NOT_IMPLIED) & (method > Method.LINEAR)


def solved_again(first: Callable, exact: Callable, failed: Callable, arguments: Any) -> Any:
    """``first(arguments)``, or ``exact(arguments)`` where that has failed, in one program, to be transformed.

    The derivative is the derivative of `exact`, with its value: to differentiate both would compile two programs. Values of the two differ by
    the tolerance of the solver.

    Args:
        first, exact: the run with the first matrix and with exact matrices, functions of one pytree of arrays.
        failed: whether a value of `first` is to be computed again.
        arguments: of both.
    """

    @jax.custom_jvp
    def run(arguments):
        value = first(arguments)
        return jax.lax.cond(failed(value), lambda: exact(arguments), lambda: value)

    run.defjvp(lambda primals, tangents: jax.jvp(exact, primals, tangents))
    return run(arguments)

"""How the implicit equations of a step are solved."""

from typing import Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp

from vmri_jax.mechanics.arrays import is_concrete, real_array
from vmri_jax.steppers.results import RUNNING, Result

Choice = Literal["auto", "nested", "arrowhead", "null_space", "dense"]


class Newton(eqx.Module):
    """How the implicit equations of a step are solved; every method ends at the same solution.

    | method | matrix of an iteration | cost per micro step |
    |---|---|---|
    | "nested" | slow path outside, micro intervals in order, each with a small matrix of its own | lowest |
    | "arrowhead" | the same march with exact matrices, kept over passes and steps while corrections shrink | |
    | "null_space" | the same without multipliers: matrices of the free motions alone | |
    | "dense" | exact, one dense factorisation, O(num_micro^2): baseline and oracle | highest |

    A correction that is still to come is accepted if it is below a tenth of `tolerance` times the motion (that of the slow variables
    over the macro step, that of the fast ones over a micro step), or round-off of the positions: the formula is that of `vmri_jax.steppers.accept`.

    "auto" takes "nested" where the terms can be cut into micro intervals (constant masses, potentials on the micro grid
    or kicks at the macro nodes), and "arrowhead" where they cannot; a run in which "nested" does not converge is made again by
    "arrowhead", from where it failed; under a transformation of JAX the step that fails is solved again. Which one it was is in ``StepInfo.method`` and ``Trajectory.info.method``. ``print(vm.plan(system, scheme, state))`` shows it beforehand.
    "nested" includes its special cases: a single drift along the constraints between kicks (RATTLE), and a single interval
    of higher degree (``galerkin(1, degree)``), which is solved for all variables at once in modes of time.

    Args:
        method: as above.
        tolerance: error of the increments of a step that is accepted, relative to the largest of them, slow and fast apart. Round-off of
            the positions is always accepted.
        max_iterations: after so many iterations the step fails; with "nested", so many passes.
        fixed_iterations: do exactly so many iterations and check the result afterwards, without a loop that depends
            on the data; a step that has not converged then has failed, whatever the method.

    Raises:
        ValueError: an unknown method, a tolerance that is not positive, a number of iterations below 1.
        TypeError: what is no number.
    """

    method: Choice = eqx.field(static=True, default="auto")
    tolerance: float = 1e-12
    max_iterations: int = 100
    fixed_iterations: int | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        if self.method not in get_args(Choice):
            raise ValueError(f"Newton: method is {self.method!r}; it must be one of {', '.join(get_args(Choice))}.")
        if not isinstance(self.fixed_iterations, int | None):
            raise TypeError(f"Newton: fixed_iterations is {self.fixed_iterations!r}; it must be an integer or None.")
        numbers = {"tolerance": self.tolerance, "max_iterations": self.max_iterations}
        if self.fixed_iterations is not None:
            numbers["fixed_iterations"] = self.fixed_iterations
        for name, value in numbers.items():
            if is_concrete(value) and not real_array(f"Newton: {name}", value, 0) > 0:
                raise ValueError(f"Newton: {name} is {value}; it must be positive.")

    def status(self, change, iterations):
        """`Result` after so many iterations, from the largest change still to come over what is accepted, or RUNNING."""
        goes_on = self.fixed_iterations is None and iterations < self.max_iterations
        otherwise = jnp.where(goes_on, RUNNING, Result.STAGNATED)
        return jnp.where(jnp.isfinite(change), jnp.where(change <= 1, Result.CONVERGED, otherwise), Result.NON_FINITE)

    def iterate(self, step, at, done: int = 0):
        """``step(at)`` while ``at.result`` is RUNNING, or as often as was asked for; `done` iterations are behind."""
        if self.fixed_iterations is None:
            return jax.lax.while_loop(lambda at: at.result == RUNNING, step, at)
        return jax.lax.fori_loop(done, self.fixed_iterations, lambda _, at: step(at), at)

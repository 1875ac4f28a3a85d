"""The dense solve of the reference study: Newton's iteration on all unknowns of a macro step at once, with one dense
matrix.

    vm.simulate(problem, scheme, solver=dense(), macro_dt=0.01, num_steps=100)

The matrix is the derivative of the whole residual, factorised by LAPACK: O(num_micro^3) operations per macro step.
Where the iteration fails, parts of the step are solved first (`vmri_jax.steppers.continuation`). Tests and studies take
it as their reference.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

import vmri_jax as vm
from vmri_jax.kernels import max_abs
from vmri_jax.schemes.equations import StepEquations, Unknowns
from vmri_jax.schemes.intervals import Intervals
from vmri_jax.steppers.accept import Accepted, Weights
from vmri_jax.steppers.continuation import solve_in_parts, with_dependent_constraints
from vmri_jax.steppers.results import RUNNING
from vmri_jax.steppers.solved import Solution, StepSolver, status_of
from vmri_jax.steppers.solver import iterated

MARGIN = 100.0
"""Safety factor on the contraction that quadratic convergence predicts for the next update. With a larger one most
steps take one more iteration; with a smaller one the test trusts an update that is small by chance."""
PLAIN_ITERATIONS = 15
"""Most Newton iterations of each attempt at the whole step, before parts of the step are tried.

A larger number makes failing runs slower.
"""


def dense(tolerance: float = 1e-12, max_iterations: int = 100) -> vm.Solver:
    """The dense solve as a solver of runs; arguments as of `vmri_jax.Solver`."""
    return vm.Solver(tolerance=tolerance, stepper=partial(_made, vm.Solver("exact", tolerance, max_iterations)))


def named(name: str, **settings) -> vm.Solver:
    """The dense solve for the name "dense", else the solver with the matrix of this name."""
    return dense(**settings) if name == "dense" else vm.Solver(name, **settings)


def _made(settings: vm.Solver, system: vm.System, scheme: vm.Scheme) -> "Dense":
    return Dense(settings)


def newton_direction(equations: StepEquations, x: Unknowns, residual: Unknowns) -> Unknowns:
    """``-(dR/dx)^-1 residual``."""
    (flat, unravel), (rows, by_name) = ravel_pytree(x), ravel_pytree(residual)
    matrix = jax.jacfwd(lambda z: ravel_pytree(Intervals(equations).residual(unravel(z))[0])[0])(flat)
    return by_name(-jax.scipy.linalg.lu_solve(jax.scipy.linalg.lu_factor(matrix), rows))


class Iterate(NamedTuple):
    """An iterate; `size` is the size of the update that led to it, as the ratio to the accepted correction."""

    x: Unknowns
    size: Float[Array, ""]
    iterations: Int[Array, ""]
    result: Int[Array, ""]


@dataclass(frozen=True)
class Dense(StepSolver):
    """Newton's iteration on all unknowns with one dense matrix, with continuation where it fails."""

    settings: vm.Solver

    def solve(self, equations: StepEquations, guess: Unknowns, memory) -> tuple[Solution, Any]:
        most = self.settings.max_iterations
        done = solve_in_parts(equations, guess, guess, self._iterate, most, PLAIN_ITERATIONS)
        x, weights = done.solution, Weights.of(equations)
        residual, end = Intervals(equations).residual(x)
        rows = jnp.maximum(*weights.of_momenta().largest(residual.slow, residual.fast))
        how = done.result, vm.Method.EXACT, done.iterations
        status = status_of(equations, *how, rows=rows, end=end, weights=weights)
        return Solution(x, end, with_dependent_constraints(equations, status)), memory

    def _iterate(self, equations: StepEquations, guess: Unknowns, limit, is_first):
        """Newton's iteration from a guess: (x, x, `Result`, iterations).

        Converged when the sum of all further updates is accepted (`Accepted`). With ``theta = |d_k| / |d_(k-1)|``,
        every further update is expected to shrink by ``s = theta min(1, MARGIN theta)``: quadratic convergence with a
        margin, linear convergence at worst. The sum is ``|d_k| s / (1 - s)``.
        """
        weights = Weights.of(equations)
        accepted = Accepted.of(equations, self.settings, weights)

        def iterate(last: Iterate) -> Iterate:
            residual, _ = Intervals(equations).residual(last.x)
            d = newton_direction(equations, last.x, residual)
            x = jax.tree.map(jnp.add, last.x, d)
            changes, motions, iterations = *(weights.largest(a.slow, a.fast) for a in (d, x)), last.iterations + 1
            size = accepted.ratio(changes, motions, iterations)
            is_roundoff = accepted.is_roundoff(jnp.maximum(*changes))
            result = _result(last, size, residual, is_roundoff=is_roundoff, is_last=iterations >= limit)
            return Iterate(x, size, iterations, result)

        done = iterated(iterate, Iterate(guess, jnp.asarray(jnp.inf), jnp.asarray(0), jnp.asarray(RUNNING)))
        return done.x, done.x, done.result, done.iterations

    def describe(self) -> list[str]:
        return ["dense: all unknowns of the step at once, by Newton's iteration"]


def _result(last: Iterate, size, residual: Unknowns, *, is_roundoff, is_last):
    """`Result` of an iteration, or RUNNING, from the iterate before, its residual and the `size` of the new update as
    in `Iterate`."""
    # sum of all further updates, |d_k| s / (1 - s) with s = theta min(1, MARGIN theta)
    theta = size / jnp.maximum(last.size, jnp.finfo(float).tiny)
    s = theta * jnp.minimum(1.0, MARGIN * theta)
    predicted = jnp.where(theta < 1, size * s / (1 - s), jnp.inf)
    # without two updates theta is unknown: the update itself bounds the error
    error = jnp.where(last.iterations == 0, size, predicted)

    exhausted = jnp.where(size > last.size, vm.Result.DIVERGED, vm.Result.STAGNATED)
    result = jnp.where(is_last, exhausted, RUNNING)
    result = jnp.where((theta > 0.5) & is_roundoff, vm.Result.CONVERGED_AT_ROUNDOFF, result)
    result = jnp.where(error <= 1, vm.Result.CONVERGED, result)

    functions_finite = jnp.isfinite(max_abs(residual.slow) + max_abs(residual.fast))
    broken = jnp.where(functions_finite, vm.Result.SINGULAR, vm.Result.NON_FINITE)
    return jnp.where(jnp.isfinite(size), result, broken)

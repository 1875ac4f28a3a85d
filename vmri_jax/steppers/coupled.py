"""Newton's iteration over all unknowns of a macro step at once; where it fails, over parts of the step (`continuation`)."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from vmri_jax.kernels import max_abs
from vmri_jax.mechanics.arrays import Number
from vmri_jax.schemes.equations import StepEquations, Unknowns
from vmri_jax.steppers.accept import Accepted, Weights
from vmri_jax.steppers.continuation import solve_in_parts, with_dependent_constraints
from vmri_jax.steppers.newton import dense
from vmri_jax.steppers.results import RUNNING, Method, Result
from vmri_jax.steppers.solved import Solution, Solver, ended, status_of
from vmri_jax.steppers.solvers import Newton

MARGIN = 100.0
"""Safety factor on the contraction that quadratic convergence predicts for the next update. With a larger one most steps take one more iteration;
with a smaller one the test trusts an update that is small by chance."""
PLAIN_ITERATIONS = 15
"""Most Newton iterations of each attempt at the whole step, before parts of the step are tried. A larger number makes failing runs slower."""


@dataclass(frozen=True)
class Coupled(Solver):
    """Newton's iteration on all unknowns with one dense matrix, with continuation where it fails.

    The method of the reference paper, kept as a reference for tests and studies.
    """

    newton: Newton

    def solve(self, equations: StepEquations, guess: Unknowns, memory) -> tuple[Solution, Any]:
        x, result, iterations = self._root(equations, guess)
        residual, (p_s, p_f) = equations.evaluate(x)
        weights = Weights.of(equations)
        rows = jnp.maximum(*weights.of_momenta().largest(residual.slow, residual.fast))
        end = equations.q_f + x.fast[:, -1].sum(0), p_s, p_f
        status = status_of(equations, result, Method.DENSE, iterations, rows=rows, end=end, weights=weights)
        return Solution(x, end, with_dependent_constraints(equations, status)), memory

    def _root(self, equations: StepEquations, guess: Unknowns):
        """(x, `Result`, iterations)."""
        newton = self.newton
        if newton.fixed_iterations is not None:
            x, result, iterations = self._iterate(equations, guess, newton.max_iterations)
            return x, ended(result), iterations

        def iterate(equations, guess, limit, is_first):
            x, result, k = self._iterate(equations, guess, limit)
            return x, x, result, k

        done = solve_in_parts(equations, guess, guess, iterate, newton.max_iterations, PLAIN_ITERATIONS)
        return done.solution, done.result, done.iterations

    def _iterate(self, equations: StepEquations, guess: Unknowns, limit):
        """Newton's iteration from a guess: (x, `Result`, iterations).

        Converged when the sum of all further updates is accepted (`Accepted`). With ``theta = |d_k| / |d_(k-1)|``, every further update
        is expected to shrink by ``s = theta min(1, MARGIN theta)``: quadratic convergence with a margin, linear convergence at worst.
        The sum is ``|d_k| s / (1 - s)``.
        """
        newton, weights = self.newton, Weights.of(equations)
        accepted = Accepted.of(equations, newton, weights)

        def slow_and_fast(x: Unknowns):
            return weights.largest(x.slow, x.fast)

        def iterate(last: Iterate) -> Iterate:
            # d = -(dR/dx)^-1 R
            residual = equations.residual(last.x)
            d = dense.solve(dense.factor(equations, last.x), residual)
            x = jax.tree.map(jnp.add, last.x, d)
            changes, motions, iterations = slow_and_fast(d), slow_and_fast(x), last.iterations + 1
            size = accepted.ratio(changes, motions, iterations)
            is_roundoff = accepted.is_roundoff(jnp.maximum(*changes))
            result = _result(last, size, residual, is_roundoff=is_roundoff, is_last=iterations >= limit)
            return Iterate(x, size, iterations, result)

        done = newton.iterate(iterate, Iterate(guess, jnp.asarray(jnp.inf), jnp.asarray(0), jnp.asarray(RUNNING)))
        return done.x, done.result, done.iterations

    def describe(self) -> list[str]:
        return ["all unknowns of the step at once: Newton's iteration, dense"]


class Iterate(NamedTuple):
    """An iterate; `size` is the size of the update that led to it, as the ratio to the accepted correction."""

    x: Unknowns
    size: Number
    iterations: Int[Array, ""]
    result: Int[Array, ""]


def _result(last: Iterate, size, residual: Unknowns, *, is_roundoff, is_last):
    """`Result` of an iteration, or RUNNING, from the iterate before, its residual and the `size` of the new update as in `Iterate`."""
    # sum of all further updates, |d_k| s / (1 - s) with s = theta min(1, MARGIN theta)
    theta = size / jnp.maximum(last.size, jnp.finfo(float).tiny)
    s = theta * jnp.minimum(1.0, MARGIN * theta)
    predicted = jnp.where(theta < 1, size * s / (1 - s), jnp.inf)
    # without two updates theta is unknown: the update itself bounds the error
    error = jnp.where(last.iterations == 0, size, predicted)

    exhausted = jnp.where(size > last.size, Result.DIVERGED, Result.STAGNATED)
    result = jnp.where(is_last, exhausted, RUNNING)
    result = jnp.where((theta > 0.5) & is_roundoff, Result.CONVERGED_AT_ROUNDOFF, result)
    result = jnp.where(error <= 1, Result.CONVERGED, result)

    functions_finite = jnp.isfinite(max_abs(residual.slow) + max_abs(residual.fast))
    broken = jnp.where(functions_finite, Result.SINGULAR, Result.NON_FINITE)
    return jnp.where(jnp.isfinite(size), result, broken)

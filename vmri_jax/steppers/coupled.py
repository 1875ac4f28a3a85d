"""Newton's iteration over all unknowns of a macro step at once, and in parts of the step where it fails, see `continuation`."""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vmri_jax.kernels import max_abs
from vmri_jax.mechanics.arrays import Number
from vmri_jax.schemes.equations import StepEquations, Unknowns
from vmri_jax.steppers.accept import Accepted
from vmri_jax.steppers.continuation import solve_in_parts, with_dependent_constraints
from vmri_jax.steppers.newton import dense
from vmri_jax.steppers.results import RUNNING, Method, Result
from vmri_jax.steppers.solved import Solution, Solver, ended, status_of
from vmri_jax.steppers.solvers import Newton

MARGIN = 100.0
"""Factor on the contraction that quadratic convergence promises for the next update. With more, most steps take one more iteration; with
less, an update that shrinks by luck is trusted."""
PLAIN_ITERATIONS = 15
"""Newton iterations of the first attempt, after which parts of the step are tried."""
LEAST_DAMPING = 1 / 64
"""An iteration gives up where less than this part of its update makes the next one smaller."""


@dataclass(frozen=True)
class Coupled(Solver):
    """Newton's iteration on all unknowns, with continuation where it fails.

    Every iteration solves with one dense matrix: the way of the study that is reproduced, kept as its reference.
    """

    newton: Newton

    def solve(self, equations: StepEquations, guess: Unknowns, memory) -> tuple[Solution, Any]:
        x, result, iterations = self._root(equations, guess)
        residual, (p_s, p_f) = equations.evaluate(x)
        rows = jnp.maximum(max_abs(residual.slow), max_abs(residual.fast))
        g = jnp.maximum(max_abs(residual.multiplier), max_abs(residual.slow_multiplier))
        status = status_of(equations, result, Method.DENSE, iterations, rows, g, self.newton.tolerance)
        status = with_dependent_constraints(equations, status)
        return Solution(x, (equations.q_f + x.fast[:, -1].sum(0), p_s, p_f), status), memory

    def _root(self, equations: StepEquations, guess: Unknowns):
        """(x, `Result`, iterations)."""
        newton = self.newton
        if newton.fixed_iterations is not None:
            return self._iterate(equations, guess, newton.max_iterations, damped=False)

        def iterate(equations, guess, limit, is_first):
            x, result, k = self._iterate(equations, guess, limit, ~is_first)
            return x, x, result, k

        done = solve_in_parts(equations, guess, guess, iterate, newton.max_iterations, PLAIN_ITERATIONS)
        return done.solution, done.result, done.iterations

    def _iterate(self, equations: StepEquations, guess: Unknowns, limit, damped):
        """Newton's iteration from a guess: (x, `Result`, iterations).

        Converged when the updates that are still to come are accepted (`Accepted`). With the contraction
        ``theta = |d_k| / |d_(k-1)|`` the next one is expected to be ``|d_k| theta min(1, MARGIN theta)``: quadratic
        convergence with a margin, linear convergence at worst.

        Where `damped`, an update that leads to a larger next one is taken back and halved (natural monotonicity test).
        """
        newton, accepted = self.newton, Accepted.of(equations, self.newton)

        def iterate(at: Iterate) -> Iterate:
            residual = equations.residual(at.x)
            d = dense.solve(dense.factor(equations, at.x), residual)
            x = jax.tree.map(jnp.add, at.x, d)
            changes, motions = _slow_and_fast(d), _slow_and_fast(x)
            update = accepted.over(changes, motions, at.iterations + 1)
            back = damped & ~(update < (1 - at.damping / 4) * at.update)
            damping = jnp.where(back, at.damping / 2, jnp.minimum(2 * at.damping, 1.0))
            is_roundoff = accepted.is_roundoff(jnp.maximum(*changes))
            result = _result(at, update, is_roundoff, damping, residual, at.iterations + 1 >= limit, back)
            before, d = jax.tree.map(partial(jnp.where, back), (at.before, at.direction), (at.x, d))
            x = jax.tree.map(lambda a, b: a + damping * b, before, d)
            return Iterate(x, before, d, jnp.where(back, at.update, update), damping, at.iterations + 1, result)

        start = Iterate(guess, guess, guess, jnp.inf, jnp.ones(()), jnp.asarray(0), jnp.asarray(RUNNING))
        done = newton.iterate(iterate, start)
        if newton.fixed_iterations is not None:
            done = done._replace(result=ended(done.result))
        return done.x, done.result, done.iterations

    def describe(self) -> list[str]:
        return ["all unknowns of the step at once: Newton's iteration, dense"]


class Iterate(NamedTuple):
    """A point x with the last accepted one, its update (a direction) and how large that was, over what is accepted."""

    x: Unknowns
    before: Unknowns
    direction: Unknowns
    update: Number
    damping: Float[Array, ""]
    iterations: Int[Array, ""]
    result: Int[Array, ""]


def _slow_and_fast(x: Unknowns):
    """Largest slow and largest fast increment."""
    return max_abs(x.slow), max_abs(x.fast)


def _result(at: Iterate, update, is_roundoff, damping, residual: Unknowns, is_last, back):
    """`Result` of an iteration, or RUNNING.

    Args:
        at: the iteration before.
        update: largest change of an increment over the change that is accepted.
        is_roundoff: whether that change is round-off of the positions.
        damping: of the next update.
        is_last: whether no iterations are left.
        back: whether the update has been taken back.
    """
    contraction = update / jnp.maximum(at.update, jnp.finfo(float).tiny)
    shrink = contraction * jnp.minimum(1.0, MARGIN * contraction)
    predicted = jnp.where(contraction < 1, update * shrink / (1 - shrink), jnp.inf)
    error = jnp.where((at.iterations == 0) | (at.damping < 1), update, predicted)

    last = jnp.where(update > at.update, Result.DIVERGED, Result.STAGNATED)
    result = jnp.where(is_last, last, RUNNING)
    result = jnp.where(damping < LEAST_DAMPING, Result.DIVERGED, result)
    result = jnp.where((contraction > 0.5) & is_roundoff, Result.CONVERGED_AT_ROUNDOFF, result)
    result = jnp.where(error <= 1, Result.CONVERGED, result)

    functions_finite = jnp.isfinite(max_abs(residual.slow) + max_abs(residual.fast))
    broken = jnp.where(functions_finite, Result.SINGULAR, Result.NON_FINITE)
    return jnp.where(jnp.isfinite(update) | (back & (result == RUNNING)), result, broken)

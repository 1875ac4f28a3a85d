"""Continuation in the length of a step, where Newton's iteration from the guess fails.

A step may have several solutions; the physical one is connected to the straight motion of a short step. If plain
iteration from the guess fails, the solver solves the equations of a shorter step, then of longer and longer ones, each
from the scaled solution of the one before (Deuflhard, *Newton Methods for Nonlinear Problems*, 2011, chapter 5). The
stride doubles after a success and halves after a part that ends early, by a singular matrix or a NaN; a part that uses
up all iterations ends the continuation. Plain iteration and continuation are one loop, compiled once; a step that
converges at once takes one turn.

The first attempt is the whole step from the prediction of the steps before, the second the whole step from straight
motion, all further attempts are parts of the step.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vmri_jax.kernels import max_abs
from vmri_jax.mechanics.constraints import is_rank_deficient
from vmri_jax.schemes.equations import StepEquations, Unknowns
from vmri_jax.steppers.results import RUNNING, Result
from vmri_jax.steppers.solver import iterated
from vmri_jax.steppers.stepper import StepStatus

SHORTEST_PART = 1 / 64
"""Smallest stride, relative to the step.

Continuation has failed if it would need a smaller one; a smaller value makes failing runs slower.
"""
RANK = 1e-7
"""Constraint gradients, in the norm of the kinetic energy and scaled to length one, count as dependent if their
smallest singular value is below this number. A larger value names nearly dependent constraints as the cause of a failed
step."""


class Part(NamedTuple):
    """An attempt at a part of the step.

    length, stride: length of the part relative to the step, and its excess over the longest part solved so far.
    rates: unknowns of the longest solved part: increments divided by its length, multipliers lambda.
    solution: of the last attempt, any pytree.
    attempts: number of attempts so far.
    """

    length: Float[Array, ""]
    stride: Float[Array, ""]
    rates: Unknowns
    solution: Any
    result: Int[Array, ""]
    iterations: Int[Array, ""]
    attempts: Int[Array, ""]

    def after(self, solution, rates: Unknowns, result, iterations, most) -> "Part":
        """The next attempt.

        Args:
            solution, rates, result, iterations: of this attempt.
            most: iterations that were left to this attempt; if it used all of them, no attempt follows.
        """
        good, is_first = result <= Result.CONVERGED_AT_ROUNDOFF, self.attempts == 0
        solved = jnp.where(good, self.length, self.length - self.stride)
        # the second attempt is the whole step again: after the first failure the stride stays
        stride = jnp.where(good, 2.0, jnp.where(is_first, 1.0, 0.5)) * self.stride
        rates = jax.tree.map(partial(jnp.where, good), rates, self.rates)
        goes_on = jnp.where(good, self.length < 1, (stride >= SHORTEST_PART) & (iterations < most))
        result = jnp.where(goes_on, RUNNING, result)
        length = jnp.minimum(solved + stride, 1.0)
        return Part(length, length - solved, rates, solution, result, self.iterations + iterations, self.attempts + 1)


def solve_in_parts(
    equations: StepEquations, guess: Unknowns, solution, iterate: Callable, max_iterations, plain_iterations: int
) -> Part:
    """The whole step at once; if that fails, part by part.

    Args:
        equations: of the step.
        guess: straight motion, from which attempts start until a part is solved; then they start from its scaled
            solution.
        solution: any pytree of the type of solutions.
        iterate: function of the equations of the part, a guess, the most iterations, and whether this is the first
            attempt; returns a solution, its unknowns, `Result` and the number of iterations.
        max_iterations: of all attempts together.
        plain_iterations: of each of the first two attempts. An attempt that needs more is far from the guess, and might
            end at another solution than the physical one.
    """

    def attempt(part: Part) -> Part:
        shorter = eqx.tree_at(lambda e: e.macro_dt, equations, part.length * equations.macro_dt)
        most = max_iterations - part.iterations
        limit = jnp.where(part.attempts < 2, jnp.minimum(most, plain_iterations), most)
        guess = scaled(part.rates, part.length, shorter.multiplier_scales())
        solution, x, result, iterations = iterate(shorter, guess, limit, part.attempts == 0)
        return part.after(solution, rates_of(x, shorter, part.length), result, iterations, most)

    start = jnp.where(starts_finite(equations), RUNNING, Result.NON_FINITE)  # no attempt after a failed step
    rates = rates_of(guess, equations, 1.0)
    whole = Part(jnp.ones(()), jnp.ones(()), rates, solution, start, jnp.asarray(0), jnp.asarray(0))
    return iterated(attempt, whole)


def starts_finite(equations: StepEquations):
    """Whether the momenta at the start are finite; they are not after a failed step."""
    return jnp.isfinite(max_abs(equations.p_s) + max_abs(equations.p_f))


def rates_of(x: Unknowns, equations: StepEquations, length) -> Unknowns:
    """The unknowns of a part of the step, of this relative length, as `Part.rates`."""
    scales = (1 / jnp.where(scale == 0, jnp.inf, scale) for scale in equations.multiplier_scales())
    return scaled(x, 1 / length, scales)


def scaled(x: Unknowns, factor, scales) -> Unknowns:
    """Increments times a factor, multipliers times scales."""
    scale, slow_scale = scales
    multipliers = {"slow_multiplier": slow_scale * x.slow_multiplier, "multiplier": scale * x.multiplier}
    return Unknowns(slow=factor * x.slow, fast=factor * x.fast, **multipliers)


def with_dependent_constraints(equations: StepEquations, status: StepStatus) -> StepStatus:
    """The status of a step, with RANK_DEFICIENT as the result if it failed and constraints are dependent."""
    system, q_s, q_f = equations.system, equations.q_s, equations.q_f
    if not system.is_constrained:
        return status

    def has_dependent_constraints():
        # the fast variables alone must be able to satisfy g on the micro grid, the slow ones g_s
        jacobians = (
            *jax.jacrev(system.g, argnums=(1, 2))(equations.t, q_s, q_f),
            jax.jacrev(system.g_slow, 1)(equations.t, q_s),
        )
        m_s, m_f = equations.mass_diagonal()
        g_s, g_f, g_slow = (g / jnp.sqrt(m) for g, m in zip(jacobians, (m_s, m_f, m_s), strict=True))
        return is_rank_deficient(g_f, g_s, RANK) | is_rank_deficient(g_slow, tolerance=RANK)

    failed = (status.result > Result.CONVERGED_AT_ROUNDOFF) & starts_finite(equations)
    dependent = jax.lax.cond(failed, has_dependent_constraints, lambda: jnp.asarray(False))
    return status._replace(result=jnp.where(dependent, Result.RANK_DEFICIENT, status.result))

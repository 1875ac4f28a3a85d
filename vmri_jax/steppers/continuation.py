"""Continuation in the length of a step, where Newton's iteration from the guess fails.

The solution that is meant is the one connected to the straight motion of a short step. Where plain iteration does not find
it from the guess, the equations are solved for parts of the step, each from the solution of the part before and with care
(Deuflhard, *Newton Methods for Nonlinear Problems*, 2011, chapters 3 and 5). The parts grow while that succeeds and shrink where
it does not. Plain iteration and continuation are one loop, compiled once, and the second costs nothing where the first suffices.

Attempts are: the whole step from what the steps before lead to; the whole step from straight motion; parts of it.
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
from vmri_jax.steppers.stepper import Status

SHORTEST_PART = 1 / 64
"""Continuation gives up where it would have to advance by less than this part of the step."""
RANK = 1e-7
"""Constraint rows of length one whose smallest singular value is below this are dependent."""


class Part(NamedTuple):
    """A part of the step that is tried.

    length, stride: its length over that of the step, and by how much it is longer than the part solved before.
    rates: unknowns of the longest part that has been solved, per length (multipliers: per length squared).
    solution: of the last attempt, any tree.
    attempts: how many there were.
    """

    length: Float[Array, ""]
    stride: Float[Array, ""]
    rates: Unknowns
    solution: Any
    result: Int[Array, ""]
    iterations: Int[Array, ""]
    attempts: Int[Array, ""]

    def after(self, solution, x: Unknowns, result, iterations, most) -> "Part":
        """The part to try next, after this one gave x; it might have taken `most` iterations."""
        good, is_first = result <= Result.CONVERGED_AT_ROUNDOFF, self.attempts == 0
        solved = jnp.where(good, self.length, self.length - self.stride)
        stride = (
            jnp.where(good, 2.0, jnp.where(is_first, 1.0, 0.5)) * self.stride
        )  # the second attempt is the whole step, too
        rates = jax.tree.map(partial(jnp.where, good), stretched(x, 1 / self.length), self.rates)
        goes_on = jnp.where(good, self.length < 1, (stride >= SHORTEST_PART) & (iterations < most))
        result = jnp.where(goes_on, RUNNING, result)
        length = jnp.minimum(solved + stride, 1.0)
        return Part(length, length - solved, rates, solution, result, self.iterations + iterations, self.attempts + 1)


def solve_in_parts(
    equations: StepEquations, guess: Unknowns, solution, iterate: Callable, max_iterations, plain_iterations: int
) -> Part:
    """The whole step at once; where that fails, part by part.

    Args:
        equations: of the step.
        guess: straight motion, from which all attempts but the first one start.
        solution: any tree of the type of solutions.
        iterate: ``(equations of the part, guess, most iterations, whether it is the first attempt) -> (solution, its unknowns,
            Result, iterations)``.
        max_iterations: of all attempts together.
        plain_iterations: of each of the first two attempts. One that needs more has lost its way, and might end at another solution
            than the one meant.
    """

    def attempt(at: Part) -> Part:
        shorter = eqx.tree_at(lambda e: e.macro_dt, equations, at.length * equations.macro_dt)
        most = max_iterations - at.iterations
        limit = jnp.where(at.attempts < 2, jnp.minimum(most, plain_iterations), most)
        found = iterate(shorter, stretched(at.rates, at.length), limit, at.attempts == 0)
        solution, x, result, iterations = found
        return at.after(solution, x, result, iterations, most)

    tried = jnp.where(starts_finite(equations), RUNNING, Result.NON_FINITE)  # after a failure nothing is tried
    whole = Part(jnp.ones(()), jnp.ones(()), guess, solution, tried, jnp.asarray(0), jnp.asarray(0))
    return jax.lax.while_loop(lambda at: at.result == RUNNING, attempt, whole)


def starts_finite(equations: StepEquations):
    """Whether the step starts from numbers: it does not where a step before it failed."""
    return jnp.isfinite(max_abs(equations.p_s) + max_abs(equations.p_f))


def stretched(x: Unknowns, factor) -> Unknowns:
    """The unknowns of a step that is `factor` times as long, to first order: increments by it, multipliers by its square."""
    multipliers = {"slow_multiplier": factor**2 * x.slow_multiplier, "multiplier": factor**2 * x.multiplier}
    return Unknowns(slow=factor * x.slow, fast=factor * x.fast, **multipliers)


def has_dependent_constraints(equations: StepEquations):
    """Whether, at the start of the step, the constraints have rank less than their number where they are held.

    g on the micro grid must be satisfiable by the fast variables alone, g_s by the slow ones.
    """
    system, q_s, q_f = equations.system, equations.q_s, equations.q_f
    g_s, g_f = jax.jacrev(system.g, argnums=(1, 2))(equations.t, q_s, q_f)
    g_slow = jax.jacrev(system.g_slow, argnums=1)(equations.t, q_s)
    return is_rank_deficient(g_f, g_s, RANK) | is_rank_deficient(g_slow, tolerance=RANK)


def with_dependent_constraints(equations: StepEquations, status: Status) -> Status:
    """The status of a step, RANK_DEFICIENT where it failed and constraints are dependent."""
    if not equations.system.is_constrained:
        return status
    failed = (status.result > Result.CONVERGED_AT_ROUNDOFF) & starts_finite(equations)
    dependent = jax.lax.cond(failed, lambda: has_dependent_constraints(equations), lambda: jnp.asarray(False))
    return status._replace(result=jnp.where(dependent, Result.RANK_DEFICIENT, status.result))

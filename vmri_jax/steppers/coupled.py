"""Newton's iteration over all unknowns of a macro step, and what is done where it fails.

The solution that is meant is the one connected to the straight motion of a short step. Where plain Newton does not find
it from the guess, the equations are solved for parts of the step, each from the solution of the part before and with
damped updates: *continuation* in the length of the step (Deuflhard, *Newton Methods for Nonlinear Problems*, 2011,
chapters 3 and 5). The parts grow while that succeeds and shrink where it does not. Plain iteration and continuation are
one loop, compiled once, and the second costs nothing where the first suffices.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vmri_jax.kernels import max_abs
from vmri_jax.mechanics.arrays import Number
from vmri_jax.mechanics.constraints import is_rank_deficient
from vmri_jax.schemes.equations import StepEquations, Unknowns
from vmri_jax.steppers.newton import Newton, arrowhead, dense, null_space
from vmri_jax.steppers.results import RUNNING, Method, Result
from vmri_jax.steppers.solved import Solution, Solver, status_of

SAFETY = 100.0
"""Margin on the quadratic convergence that is expected of Newton's iteration."""
ROUNDOFF_FLOOR = 100.0
"""Updates below this many units of round-off of the positions that no longer shrink are at the floor."""
PLAIN_ITERATIONS = 15
"""Plain Newton that needs more has lost its way: then continuation is cheaper, and does not end at another solution."""
SHORTEST_PART = 1 / 64
"""Continuation gives up where it would have to advance by less than this part of the step."""
RANK = 1e-7
"""Constraint rows of length one whose smallest singular value is below this are dependent."""
LEAST_DAMPING = 1 / 64
"""An iteration gives up where less than this part of its update makes the next one smaller."""


LinearSolver = Literal["arrowhead", "null_space", "dense"]
LINEAR_SOLVERS: dict[LinearSolver, tuple[Callable, Callable]] = {
    "arrowhead": (arrowhead.factor, arrowhead.solve),
    "null_space": (partial(arrowhead.factor, inverse=null_space.inverse), arrowhead.solve),
    "dense": (dense.factor, dense.solve),
}
"""How Newton's direction is found: factors of the matrix at x, and the direction for a residual."""


@dataclass(frozen=True)
class Coupled(Solver):
    """Newton's iteration on all unknowns, with continuation where it fails.

    linear_solver: "arrowhead", block elimination in O(num_micro), "null_space", the same without multipliers, or "dense", one
        factorisation.
    sizes: (n_s, n_gs, n_f, n_g) and the degree, which are told where multipliers are eliminated.
    """

    newton: Newton
    linear_solver: LinearSolver
    sizes: tuple[int, int, int, int, int] | None = None

    def solve(self, equations: StepEquations, guess: Unknowns, own) -> tuple[Solution, Any]:
        x, result, iterations = self._root(equations, guess)
        residual, (p_s, p_f) = equations.evaluate(x)
        rows = jnp.maximum(max_abs(residual.slow), max_abs(residual.fast))
        g = jnp.maximum(max_abs(residual.multiplier), max_abs(residual.slow_multiplier))
        method = Method[self.linear_solver.upper()]
        status = status_of(equations, result, method, iterations, rows, g, self.newton.tolerance)
        if equations.system.is_constrained:
            failed = (status.result > Result.CONVERGED_AT_ROUNDOFF) & _starts_finite(equations)
            never = partial(jnp.asarray, False)
            dependent = jax.lax.cond(failed, partial(has_dependent_constraints, equations), never)
            status = status._replace(result=jnp.where(dependent, Result.RANK_DEFICIENT, status.result))
        return Solution(x, (equations.q_f + x.fast[:, -1].sum(0), p_s, p_f), status), own

    def _root(self, equations: StepEquations, guess: Unknowns):
        """(x, `Result`, iterations)."""
        newton = self.newton
        if newton.fixed_iterations is not None:
            return self._iterate(equations, guess, newton.max_iterations, damped=False)

        def attempt(at: Part) -> Part:
            damped = at.iterations > 0
            shorter = eqx.tree_at(lambda e: e.macro_dt, equations, at.length * equations.macro_dt)
            left = newton.max_iterations - at.iterations
            limit = jnp.where(damped, left, jnp.minimum(left, PLAIN_ITERATIONS))
            x, result, k = self._iterate(shorter, _stretched(at.rates, at.length), limit, damped)
            return at.after(x, result, k, left)

        tried = jnp.where(_starts_finite(equations), RUNNING, Result.NON_FINITE)  # after a failure nothing is tried
        whole = Part(jnp.ones(()), jnp.ones(()), guess, guess, tried, jnp.asarray(0))
        done = jax.lax.while_loop(lambda at: at.result == RUNNING, attempt, whole)
        return done.x, done.result, done.iterations

    def _iterate(self, equations: StepEquations, guess: Unknowns, limit, damped):
        """Newton's iteration from a guess: (x, `Result`, iterations).

        Converged when the predicted size of all further updates is below ``tolerance`` times the increments, or round-off
        of the positions. With the contraction ``theta = |d_k| / |d_(k-1)|`` the next update is expected to be
        ``|d_k| theta min(1, SAFETY theta)``: quadratic convergence with a margin, linear convergence at worst.

        Where `damped`, an update that leads to a larger next one is taken back and halved (natural monotonicity test).
        """
        factor, solve = LINEAR_SOLVERS[self.linear_solver]
        newton = self.newton

        def iterate(at: Iterate) -> Iterate:
            residual = equations.residual(at.x)
            d = solve(factor(equations, at.x), residual)
            x = jax.tree.map(jnp.add, at.x, d)
            update = _size(equations, d, x, newton.tolerance)
            back = damped & ~(update < (1 - at.damping / 4) * at.update)
            damping = jnp.where(back, at.damping / 2, jnp.minimum(2 * at.damping, 1.0))
            result = _result(equations, at, d, update, damping, residual, at.iterations + 1 >= limit, back)
            before, d = jax.tree.map(partial(jnp.where, back), (at.before, at.direction), (at.x, d))
            x = jax.tree.map(lambda a, b: a + damping * b, before, d)
            return Iterate(x, before, d, jnp.where(back, at.update, update), damping, at.iterations + 1, result)

        start = Iterate(guess, guess, guess, jnp.inf, jnp.ones(()), jnp.asarray(0), jnp.asarray(RUNNING))
        done = newton.iterate(iterate, start)
        if newton.fixed_iterations is not None:
            done = done._replace(result=jnp.where(done.result == RUNNING, Result.STAGNATED, done.result))
        return done.x, done.result, done.iterations

    def lines(self) -> list[str]:
        head = f"all unknowns of the step at once: Newton's iteration, {self.linear_solver.replace('_', ' ')}"
        if self.linear_solver != "null_space" or self.sizes is None:
            return [head]
        *counts, r = self.sizes
        parts = zip(("slow variables", "each micro interval"), counts[::2], counts[1::2], strict=True)
        few = [f"  unknowns of {what}: {r * (n - g)}, with multipliers {r * (n + g)}" for what, n, g in parts if g]
        return [head, *few]


class Part(NamedTuple):
    """A part of the step that is tried.

    length, stride: its length over that of the step, and by how much it is longer than what has been solved.
    rates: unknowns of the longest part that has been solved, per length (multipliers: per length squared).
    """

    length: Float[Array, ""]
    stride: Float[Array, ""]
    rates: Unknowns
    x: Unknowns
    result: Int[Array, ""]
    iterations: Int[Array, ""]

    def after(self, x: Unknowns, result, iterations, left) -> "Part":
        """The part to try next, after this one gave x; `left` iterations were left for it."""
        good = result <= Result.CONVERGED_AT_ROUNDOFF
        solved = jnp.where(good, self.length, self.length - self.stride)
        stride = jnp.where(good, 2.0, 0.5) * self.stride
        rates = jax.tree.map(partial(jnp.where, good), _stretched(x, 1 / self.length), self.rates)
        goes_on = jnp.where(good, self.length < 1, (stride >= SHORTEST_PART) & (iterations < left))
        result = jnp.where(goes_on, RUNNING, result)
        length = jnp.minimum(solved + stride, 1.0)
        return Part(length, length - solved, rates, x, result, self.iterations + iterations)


def _starts_finite(equations: StepEquations):
    """Whether the step starts from numbers: it does not where a step before it failed."""
    return jnp.isfinite(max_abs(equations.p_s) + max_abs(equations.p_f))


def _stretched(x: Unknowns, factor) -> Unknowns:
    """The unknowns of a step that is `factor` times as long, to first order: increments by it, multipliers by its square."""
    multipliers = {"slow_multiplier": factor**2 * x.slow_multiplier, "multiplier": factor**2 * x.multiplier}
    return Unknowns(slow=factor * x.slow, fast=factor * x.fast, **multipliers)


class Iterate(NamedTuple):
    """A point x with the last accepted one, its update (a direction) and how large that was, over what is accepted."""

    x: Unknowns
    before: Unknowns
    direction: Unknowns
    update: Number
    damping: Float[Array, ""]
    iterations: Int[Array, ""]
    result: Int[Array, ""]


def _size(equations: StepEquations, d: Unknowns, x: Unknowns, tolerance):
    """Largest update over what is accepted, slow and fast each by its own measure.

    Variables that only see round-off of the others (a centre of mass at rest) have no size of their own.
    """
    eps, tiny = jnp.finfo(float).eps, jnp.finfo(float).tiny
    others = eps * jnp.maximum(max_abs(x.slow), max_abs(x.fast)) + tiny
    slow = max_abs(d.slow) / (tolerance * max_abs(x.slow) + eps * max_abs(equations.q_s) + others)
    fast = max_abs(d.fast) / (tolerance * max_abs(x.fast) + eps * max_abs(equations.q_f) + others)
    return jnp.maximum(slow, fast)


def _result(equations: StepEquations, at: Iterate, d: Unknowns, update, damping, residual: Unknowns, is_last, back):
    """`Result` of an iteration that made the update d, or RUNNING."""
    eps, tiny = jnp.finfo(float).eps, jnp.finfo(float).tiny
    contraction = update / jnp.maximum(at.update, tiny)
    shrink = contraction * jnp.minimum(1.0, SAFETY * contraction)
    predicted = jnp.where(contraction < 1, update * shrink / (1 - shrink), jnp.inf)
    error = jnp.where((at.iterations == 0) | (at.damping < 1), update, predicted)

    positions = jnp.maximum(max_abs(equations.q_s), max_abs(equations.q_f))
    step = jnp.maximum(max_abs(d.slow), max_abs(d.fast))
    at_floor = (contraction > 0.5) & (step <= ROUNDOFF_FLOOR * eps * positions)

    last = jnp.where(update > at.update, Result.DIVERGED, Result.STAGNATED)
    result = jnp.where(is_last, last, RUNNING)
    result = jnp.where(damping < LEAST_DAMPING, Result.DIVERGED, result)
    result = jnp.where(at_floor, Result.CONVERGED_AT_ROUNDOFF, result)
    result = jnp.where(error <= 1, Result.CONVERGED, result)

    functions_finite = jnp.isfinite(max_abs(residual.slow) + max_abs(residual.fast))
    broken = jnp.where(functions_finite, Result.SINGULAR, Result.NON_FINITE)
    return jnp.where(jnp.isfinite(update) | (back & (result == RUNNING)), result, broken)


def has_dependent_constraints(equations: StepEquations):
    """Whether, at the start of the step, the constraints have rank less than their number where they are held.

    g on the micro grid must be satisfiable by the fast variables alone, g_s by the slow ones.
    """
    system, q_s, q_f = equations.system, equations.q_s, equations.q_f
    g_s, g_f = jax.jacrev(system.g, argnums=(1, 2))(equations.t, q_s, q_f)
    g_slow = jax.jacrev(system.g_slow, argnums=1)(equations.t, q_s)
    return is_rank_deficient(g_f, g_s, RANK) | is_rank_deficient(g_slow, tolerance=RANK)

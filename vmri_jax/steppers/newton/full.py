"""Newton's iteration over all unknowns of a macro step, and what is done where it fails.

The solution that is meant is the one connected to the straight motion of a short step. Where plain Newton does not find
it from the guess, the equations are solved for parts of the step, each from the solution of the part before and with
damped updates: *continuation* in the length of the step (Deuflhard, *Newton Methods for Nonlinear Problems*, 2011,
chapters 3 and 5). The parts grow while that succeeds and shrink where it does not. Plain iteration and continuation are
one loop, compiled once, and the second costs nothing where the first suffices.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from vmri_jax.kernels.cpu import largest
from vmri_jax.schemes.equations import StepEquations, Unknowns
from vmri_jax.steppers.newton import arrowhead, dense
from vmri_jax.steppers.newton.linearization import linearize
from vmri_jax.steppers.results import RUNNING, Result

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


class Part(NamedTuple):
    """A part of the step that is tried: its length and by how much it is longer than what has been solved.

    rates: unknowns of the longest part that has been solved, per length (multipliers: per length squared).
    """

    length: Any
    stride: Any
    rates: Unknowns
    x: Unknowns
    result: Any
    iterations: Any


def solve(equations: StepEquations, guess: Unknowns, newton, method: str):
    """(x, `Result`, iterations): a root of ``equations.residual``, found with the matrix that `method` names."""
    if newton.fixed_iterations is not None or method not in ("arrowhead", "dense"):
        return _iterate(equations, guess, newton, method, newton.max_iterations, damped=False)

    def attempt(at: Part) -> Part:
        damped = at.iterations > 0
        shorter = eqx.tree_at(lambda e: e.macro_dt, equations, at.length * equations.macro_dt)
        left = newton.max_iterations - at.iterations
        limit = jnp.where(damped, left, jnp.minimum(left, PLAIN_ITERATIONS))
        x, result, k = _iterate(shorter, _stretched(at.rates, at.length), newton, method, limit, damped)
        good = result <= Result.CONVERGED_AT_ROUNDOFF
        solved = jnp.where(good, at.length, at.length - at.stride)
        stride = jnp.where(good, 2.0, 0.5) * at.stride
        rates = jax.tree.map(partial(jnp.where, good), _stretched(x, 1 / at.length), at.rates)
        goes_on = jnp.where(good, at.length < 1, (stride >= SHORTEST_PART) & (k < left))
        result = jnp.where(goes_on, RUNNING, result)
        length = jnp.minimum(solved + stride, 1.0)
        return Part(length, length - solved, rates, x, result, at.iterations + k)

    whole = Part(jnp.ones(()), jnp.ones(()), guess, guess, jnp.asarray(RUNNING), jnp.asarray(0))
    done = jax.lax.while_loop(lambda at: at.result == RUNNING, attempt, whole)
    return done.x, done.result, done.iterations


def _stretched(x: Unknowns, factor) -> Unknowns:
    """The unknowns of a step that is `factor` times as long, to first order: increments by it, multipliers by its square."""
    multipliers = {"slow_multiplier": factor**2 * x.slow_multiplier, "multiplier": factor**2 * x.multiplier}
    return Unknowns(slow=factor * x.slow, fast=factor * x.fast, **multipliers)


class Iterate(NamedTuple):
    """A point x with the last accepted one, its update (a direction) and how large that was, over what is accepted."""

    x: Unknowns
    before: Unknowns
    direction: Unknowns
    update: Any
    damping: Any
    iterations: Any
    result: Any


def _iterate(equations: StepEquations, guess: Unknowns, newton, method: str, limit, damped):
    """Newton's iteration with the matrix at the present point, or at the guess; (x, `Result`, iterations).

    Converged when the predicted size of all further updates is below ``tolerance`` times the increments, or round-off
    of the positions. With the contraction ``theta = |d_k| / |d_(k-1)|`` the next update is expected to be
    ``|d_k| theta min(1, SAFETY theta)``: quadratic convergence with a margin, linear convergence at worst. A matrix
    that is not renewed converges linearly; there the last update itself has to be that small.

    Where `damped`, an update that leads to a larger next one is taken back and halved (natural monotonicity test).
    """
    renewed = method in ("arrowhead", "dense")
    solver = dense if method == "dense" else arrowhead
    factor = partial(arrowhead.factor, coupled=False) if method == "decoupled" else solver.factor
    factors = None if renewed else factor(linearize(equations, guess), guess)
    eps, tiny = jnp.finfo(float).eps, jnp.finfo(float).tiny
    positions = jnp.maximum(largest(equations.q_s), largest(equations.q_f))

    def size(d: Unknowns, x: Unknowns):
        """Largest update over what is accepted, slow and fast each by its own measure.

        Variables that only see round-off of the others (a centre of mass at rest) have no size of their own.
        """
        others = eps * jnp.maximum(largest(x.slow), largest(x.fast)) + tiny
        return jnp.maximum(
            largest(d.slow) / (newton.tolerance * largest(x.slow) + eps * largest(equations.q_s) + others),
            largest(d.fast) / (newton.tolerance * largest(x.fast) + eps * largest(equations.q_f) + others),
        )

    def iterate(at: Iterate) -> Iterate:
        now = factor(linearize(equations, at.x), at.x) if renewed else factors
        residual = equations.residual(at.x)
        d = solver.solve(now, residual)  # pyright: ignore[reportArgumentType]
        x = jax.tree.map(jnp.add, at.x, d)
        update = size(d, x)
        contraction, error = update / jnp.maximum(at.update, tiny), update
        if renewed:  # quadratic convergence: the next update is known to be much smaller
            shrink = contraction * jnp.minimum(1.0, SAFETY * contraction)
            predicted = jnp.where(contraction < 1, update * shrink / (1 - shrink), jnp.inf)
            error = jnp.where((at.iterations == 0) | (at.damping < 1), update, predicted)
        step = jnp.maximum(largest(d.slow), largest(d.fast))
        at_floor = (contraction > 0.5) & (step <= ROUNDOFF_FLOOR * eps * positions)
        last = jnp.where(update > at.update, Result.DIVERGED, Result.STAGNATED)
        running = jnp.where(at.iterations + 1 >= limit, last, RUNNING)

        back = damped & ~(update < (1 - at.damping / 4) * at.update)
        damping = jnp.where(back, at.damping / 2, jnp.minimum(2 * at.damping, 1.0))
        result = jnp.where(damping < LEAST_DAMPING, Result.DIVERGED, running)
        result = jnp.where(at_floor, Result.CONVERGED_AT_ROUNDOFF, result)
        result = jnp.where(error <= 1, Result.CONVERGED, result)
        broken = jnp.where(
            jnp.isfinite(largest(residual.slow) + largest(residual.fast)), Result.SINGULAR, Result.NON_FINITE
        )
        result = jnp.where(jnp.isfinite(update) | (back & (result == RUNNING)), result, broken)
        before, d = jax.tree.map(partial(jnp.where, back), (at.before, at.direction), (at.x, d))
        x = jax.tree.map(lambda a, b: a + damping * b, before, d)
        return Iterate(x, before, d, jnp.where(back, at.update, update), damping, at.iterations + 1, result)

    start = Iterate(guess, guess, guess, jnp.inf, jnp.ones(()), jnp.asarray(0), jnp.asarray(RUNNING))
    done = newton.iterate(iterate, start)
    if newton.fixed_iterations is not None:
        done = done._replace(result=jnp.where(done.result == RUNNING, Result.STAGNATED, done.result))
    return done.x, done.result, done.iterations


def has_dependent_constraints(equations: StepEquations):
    """Whether, at the start of the step, the constraints have rank less than their number where they are held.

    g on the micro grid must be satisfiable by the fast variables alone, g_s by the slow ones.
    """
    system, q_s, q_f = equations.system, equations.q_s, equations.q_f
    g_s, g_f = jax.jacrev(system.g, argnums=(1, 2))(equations.t, q_s, q_f)
    return _is_dependent(g_f, g_s) | _is_dependent(jax.jacrev(system.g_slow, argnums=1)(equations.t, q_s))


def _is_dependent(jacobian, others=None):
    """Whether rows (k, n) have rank less than k, each over its length (together with other columns)."""
    if jacobian.shape[0] == 0:
        return jnp.asarray(False)
    whole = jacobian if others is None else jnp.concatenate([jacobian, others], axis=1)
    rows = jacobian / jnp.maximum(jnp.linalg.norm(whole, axis=1, keepdims=True), jnp.finfo(float).tiny)
    gram = rows @ rows.T
    return jnp.isfinite(gram).all() & (jnp.linalg.eigvalsh(gram)[0] < RANK**2)

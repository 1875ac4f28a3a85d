"""Nested march: the slow path outside, the micro intervals in order inside, each solving only its own small system.

A pass takes the slow path as known. It marches over the micro intervals; each corrects its fast increments and
multipliers once, by a Newton step on its exact residual, and adds its impulse to the slow equations. Then the slow
increments and slow multipliers are corrected from what is left of their equations. The matrices are cheap ones:

* micro interval: ``[K, -G^T; G, 0]`` with K from the start of the macro step, or of one before it while that costs no passes
  (`IntervalMatrix`: the mass alone where the fast equations are explicit, so that only the multipliers are solved for), and
  ``G K^-1 G^T`` from the first pass;
* slow equations: masses, with those that constraints tie to the slow ones, and slow constraint (`SlowEquations`). What they
  miss is learned from steps with many passes where there are constraints (`Pairs`); elsewhere it is the derivative of the slow
  forces, which is taken where updates by the masses alone would cost a pass (`SlowEquations.with_forces`).

The slow unknowns start from what the steps before extrapolate to (`Differences`), the fast ones from the micro intervals
before (`Line`). The residual is exact, so all of this decides only how many passes there are: two where the slow motion is
smooth. A pass costs one gradient of each term at each of its nodes; nothing is stored but the path and those small matrices.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.kernels.cpu import inverse, largest, matvec, regularized
from vmri_jax.schemes.discrete_lagrangian import lagrangian
from vmri_jax.schemes.equations import StepEquations, Unknowns, multiplier_scales, slow_basis_at_control_nodes
from vmri_jax.schemes.path import control_nodes
from vmri_jax.steppers.newton.extrapolation import Differences, Line
from vmri_jax.steppers.newton.interval import (
    Accepted,
    IntervalMatrix,
    constant_mass,
    expected,
    has_kicks,
    interval_problem,
    inverse_mass,
    is_explicit_given_multipliers,
    is_linear,
)
from vmri_jax.steppers.newton.secant import SIZE, Pairs
from vmri_jax.steppers.newton.slow import SlowEquations
from vmri_jax.steppers.results import Result

NOISE = 3e2
"""Secant pairs shorter than so many units of round-off of the positions are not kept."""
MORE = 1
"""A matrix is renewed after a step with more than so many passes above the fewest with it."""
EASY = 2
"""Steps with so few passes do without secant pairs."""
UNKNOWN = -1


class Warm(NamedTuple):
    """What a macro step hands to the next one.

    slow: slow unknowns (r n_s + r n_gs,) of the last steps.
    multiplier, bend: multipliers lambda (r, n_g) of the last micro intervals, and by how much their fast increments (r, n_f)
        left the straight line, over h^2 (nothing is kept where any start does).
    missed: what the cheap matrix of the slow equations misses: secant pairs of the slow unknowns, or without constraints the
        part of an update that it leaves to the next one.
    passes: (2,) fewest of a step with this matrix of the micro intervals (UNKNOWN before one), and those of the last step.
    """

    slow: Differences
    multiplier: Line
    bend: Line
    missed: Any
    passes: Any

    @classmethod
    def straight(cls, equations: StepEquations, velocity) -> "Warm":
        """The start of a run: straight motion with a slow velocity (n_s,), no multipliers."""
        system, scheme, n_s, n_f = equations.system, equations.scheme, equations.q_s.size, equations.q_f.size
        r, (n_g, n_gs) = scheme.degree, system.num_constraints(equations.q_s, equations.q_f)
        increments = control_nodes(r)[1:, None] * (equations.macro_dt * velocity)
        slow = Differences.constant(jnp.concatenate([increments.reshape(-1), jnp.zeros(r * n_gs)]))
        known = is_explicit_given_multipliers(system, scheme) or is_linear(system, scheme, equations.q_s, equations.q_f)
        several, kicked = scheme.num_micro > 1, has_kicks(system, scheme)
        shared = system.constraint is not None  # two macro steps share the constraint force of their node
        multiplier = Line.zero((r, n_g), several and kicked)
        bend = Line.zero((r, 0 if known else n_f), several and (kicked or shared))
        missed = jnp.ones(())
        if system.is_constrained:
            missed = Pairs.none(r * (n_s + n_gs), min(SIZE, r * n_s))  # no more of them are independent
        return cls(slow, multiplier, bend, missed, jnp.array([0, 2 * MORE]))

    def after(self, last: "Warm") -> "Warm":
        """What a stage of a composition has learned, going on where the stage before it ended."""
        return self._replace(multiplier=self.multiplier.after(last.multiplier), bend=self.bend.after(last.bend))

    @property
    def is_stale(self):
        """Whether the matrix has come to cost passes."""
        return self.passes[1] > self.passes[0] + MORE

    def renewed(self, matrix_is_new) -> "Warm":
        """With a new matrix, or with the old one."""
        return self._replace(passes=self.passes.at[0].set(jnp.where(matrix_is_new, UNKNOWN, self.passes[0])))


class Pass(NamedTuple):
    """What a march over the micro intervals leaves.

    q_f, p_f: end of the last interval, momentum times h.
    start, increments: gradient (n_s,), (r, n_s) of h times the action by the start and the increments of the slow path,
        without their kinetic energy.
    moved: largest correction of an increment.
    """

    q_f: Any
    p_f: Any
    start: Any
    increments: Any
    moved: Any


def march(
    equations: StepEquations, matrix: IntervalMatrix, x: Unknowns, warm: Warm, scale, schur=None, linear=False
) -> tuple[Any, ...]:
    """One pass over the micro intervals: fast unknowns corrected for the given slow ones, and what they leave.

    Args:
        warm: multipliers and bends of the macro step before.
        scale: (num_micro, r, 1) what turns multipliers into unknowns.
        schur: (num_micro, r n_g, r n_g) inverses of ``G K^-1 G^T``. In the first pass there are none: they are computed, and
            multipliers and bends start from the line through the last two.
        linear: the equations are linear with the given matrix, and this is their only pass.

    Returns:
        (x, what the pass leaves, fast positions (num_micro, r, n_f) at the nodes 1..r, bends, schur)
    """
    h, (n, r, _), n_g = equations.micro_dt, x.fast.shape, x.multiplier.shape[2]
    system, scheme = interval_problem(equations.system, equations.scheme)
    terms = lagrangian(system, scheme)
    kinetic, kicks = terms.kinetic, terms.kicks if n > 1 else ()
    explicit = is_explicit_given_multipliers(equations.system, equations.scheme)
    bent = warm.bend.last.size > 0
    basis = slow_basis_at_control_nodes(n, r)[..., 1:]  # (n, r + 1, r): slow position at each node by increments
    velocity = inverse_mass(constant_mass(system).fast)
    first = schur is None
    constraints = jax.vmap(system.g)

    def interval(carry, at):
        (carry, lines), (m, basis, scale, inside, inc, mu, schur) = carry, at
        q_s, steps = equations.q_s + _along(basis[0], x.slow), _along(basis[1:] - basis[0], x.slow)
        none = jnp.zeros_like(q_s), jnp.zeros_like(carry.q_f)
        local = StepEquations(system, scheme, equations.t + m * h, q_s, carry.q_f, *none, h)
        slow_nodes, times = jnp.concatenate([q_s[None], q_s + steps]), local.t + h * control_nodes(r)
        straight = control_nodes(r)[1:, None] * velocity(carry.p_f)
        if first:
            multipliers, bends = lines
            mu = scale * multipliers.next(m)
            inc = jnp.zeros_like(straight)
            if bent:
                inc = straight + h**2 * bends.next(m)

        def gradient(inc):
            path = local.path(Unknowns(steps, None, inc[None], None))
            return jax.grad(local.without_kinetic)(path, path)

        fast_nodes = jnp.concatenate([carry.q_f[None], carry.q_f + inc[:-1]])
        pull = _forces(system, times[:-1], slow_nodes[:-1], fast_nodes, stored=not explicit)
        pull_s, pull_f = pull(mu)
        if explicit:  # the increment follows from the multipliers
            inc = -matrix.solve(carry.p_f - pull_f)
        d, change = jax.linearize(gradient, inc)
        d_fast = d.fast[0] if linear else d.fast[0] + kinetic.rows(steps, inc)[1]  # the one pass is at zero increments
        g, push = jax.linearize(lambda inc: constraints(times[1:], slow_nodes[1:], carry.q_f + inc), inc)
        dx, change_of_g = jnp.zeros_like(inc), g
        if not explicit:
            rows = jnp.concatenate([(d.fast_start - d_fast.sum(0)) + carry.p_f, d_fast[:-1]])
            dx = -matrix.solve(rows - pull_f)
            change_of_g = g + push(dx)
        if first:
            units = jnp.eye(r * n_g).reshape(r * n_g, r, n_g)
            columns = jax.vmap(lambda unit: push(matrix.solve(pull(unit)[1])))(units)
            schur = inverse(regularized(columns.reshape(r * n_g, r * n_g))).T
        dmu = -matvec(schur, change_of_g.reshape(-1)).reshape(r, n_g)
        more_s, more_f = pull(dmu)
        if n_g:
            dx += matrix.solve(more_f)
        inc, mu, coupling = inc + dx, mu + dmu, change(dx)
        q_f, p_f = carry.q_f + inc[-1], d_fast[-1] + matrix.outgoing(dx)
        moved = jnp.maximum(carry.moved, largest(dx))

        pull_s = -(pull_s + more_s)
        d_start = d.slow_start + coupling.slow_start + pull_s.sum(0)
        d_steps = d.slow + coupling.slow + jnp.concatenate([pull_s[1:], jnp.zeros_like(pull_s[:1])])
        start = carry.start + d_start
        increments = carry.increments + basis[0][:, None] * d_start
        increments += jnp.sum((basis[1:] - basis[0])[..., None] * d_steps[:, None], axis=0)
        for term in kicks:  # where two micro intervals meet
            d_s, d_f = term.gradient(equations.q_s + _along(basis[-1], x.slow), q_f)
            weight = h * term.times_step(h) * sum(w for w in (term.start, term.end) if w is not None)
            weight = jnp.where(inside, weight, 0.0)
            start, p_f = start + weight * d_s, p_f + weight * d_f
            increments += basis[-1][:, None] * (weight * d_s)

        bend = (inc - straight) / h**2 if bent else None
        if first:
            lines = multipliers.add(m, mu / scale), bends.add(m, bend) if bent else bends
        end = Pass(q_f, p_f, start, increments, moved)
        return (end, lines), (inc, mu, carry.q_f + inc, bend, schur if first else None)

    zero = jnp.zeros_like(equations.q_s), jnp.zeros_like(x.slow), jnp.zeros(())
    carry = Pass(equations.q_f, h * equations.p_f, *zero), (warm.multiplier, warm.bend) if first else None
    m = jnp.arange(n)
    unknowns = (None, None, None) if first else (x.fast, x.multiplier, schur)
    intervals = m, jnp.asarray(basis), scale, m < n - 1, *unknowns
    (end, _), (fast, mu, nodes, bends, new) = jax.lax.scan(interval, carry, intervals)
    return x._replace(fast=fast, multiplier=mu), end, nodes, bends, new if first else schur


def _forces(system, times, slow_nodes, fast_nodes, stored: bool):
    """``G^T mu`` of multipliers at these nodes, slow and fast part; with stored Jacobians, or as products of derivatives.

    Products are cheaper, unless what consumes them is a dense product, into which the compiler would copy them.
    """
    if not stored:
        return jax.vjp(partial(jax.vmap(system.g), times), slow_nodes, fast_nodes)[1]
    g_s, g_f = jax.vmap(jax.jacrev(system.g, argnums=(1, 2)))(times, slow_nodes, fast_nodes)
    return lambda mu: (jnp.sum(mu[..., None] * g_s, axis=1), jnp.sum(mu[..., None] * g_f, axis=1))


class March(NamedTuple):
    """State of the iteration: unknowns of this pass, what it left and moved, and how it stands.

    nodes, bends: fast positions (num_micro, r, n_f) at the nodes 1..r of the micro intervals, and what `Warm` keeps of them.
    schur: small matrices of the micro intervals, from the first pass.
    tied: masses that constraints tie to the slow variables, from the first pass.
    d: the update of the slow unknowns by the cheap matrix.
    missed: as in `Warm`.
    impulse: on the slow variables over the step, times h.
    residual: largest row of the momentum equations (times h) and largest value of the slow constraint.
    """

    x: Unknowns
    end: Pass
    nodes: Any
    bends: Any
    schur: Any
    tied: Any
    d: Any
    missed: Any
    impulse: Any
    residual: Any
    passes: Any
    result: Any


def solve(equations: StepEquations, matrix: IntervalMatrix, warm: Warm, newton, linear: bool) -> tuple[March, Warm]:
    """Passes until one more would change neither the slow increments nor those of the micro intervals.

    What it would change the slow ones by is known from the residual, and the others from how their corrections shrink, as in
    stiff solvers (Hairer, Wanner, Solving Ordinary Differential Equations II, IV.8). Accepted are changes of
    ``newton.tolerance`` relative to the motion over the macro step and over a micro interval, and round-off of the positions.

    Args:
        matrix, warm: K of the micro intervals, and what the step before handed on.
        newton: tolerance, max_iterations and fixed_iterations.
        linear: the equations are linear with the given matrix (`is_linear`), so that one pass solves them.
    """
    system, scheme, h = equations.system, equations.scheme, equations.micro_dt
    n, r, n_s, n_f = scheme.num_micro, scheme.degree, equations.q_s.shape[0], equations.q_f.shape[0]
    n_g, _ = system.num_constraints(equations.q_s, equations.q_f)
    numbers = jnp.finfo(float)
    mass = constant_mass(system)
    inverse_fast, outer = inverse_mass(mass.fast), SlowEquations.of(equations)
    accepted = Accepted.of(equations, newton)
    scale, _ = multiplier_scales(scheme, equations.macro_dt)

    def one_pass(x: Unknowns, last: March | None = None) -> March:
        first = last is None
        x, end, nodes, bends, schur = march(equations, matrix, x, warm, scale, None if first else last.schur, linear)
        tied = outer.tied(schur[0]) if first else last.tied
        d, (rows, g), impulse = outer.update(x, end.start, end.increments, tied)
        motion = jnp.maximum(largest(inverse_fast(h * equations.p_f)), largest(inverse_fast(end.p_f)))
        left = end.moved if first else expected(end.moved, last.end.moved)
        missed, passes = (warm.missed, 1) if first else (last.missed, last.passes + 1)
        result = newton.status(accepted.over((largest(d[: r * n_s]), left), (largest(x.slow), motion)), passes)
        residual = jnp.maximum(largest(rows), largest(mass.fast) * left), largest(g)
        return March(x, end, nodes, bends, schur, tied, d, missed, impulse, residual, jnp.asarray(passes), result)

    def next_pass(last: March) -> March:
        if not n_s:
            return one_pass(last.x, last)
        return with_pairs(last) if system.is_constrained else with_forces(last)

    def with_pairs(last: March) -> March:
        pairs, is_hard = last.missed, (warm.passes[1] > EASY) | (last.passes >= EASY)
        d = jax.lax.cond(is_hard, lambda: pairs.corrected(last.d, r * n_s), lambda: last.d)
        now, noise = moved_by(d, last), NOISE * numbers.eps * (largest(equations.q_s) + largest(last.x.slow))
        pairs = jax.lax.cond(is_hard, lambda: pairs.add(d, now.d - last.d, noise, r * n_s), lambda: pairs)
        return now._replace(missed=pairs)

    def with_forces(last: March) -> March:
        part = jnp.where(last.passes == 1, last.missed**2, last.missed)  # the fast unknowns take three passes anyway
        is_hard = part * accepted.over((largest(last.d), 0.0), (largest(last.x.slow), 0.0)) > 1
        wanted = jnp.where(is_hard, last.d, 0.0)  # lanes of a batch that are not hard take no part
        d = jax.lax.cond(is_hard, lambda: outer.with_forces(wanted, last.x), lambda: last.d)
        now = moved_by(d, last)
        missed, of = jnp.where(is_hard, jnp.stack([d - last.d, d]), jnp.stack([now.d, last.d]))
        return now._replace(missed=largest(missed) / (largest(of) + numbers.tiny))

    def moved_by(d, last: March) -> March:
        return one_pass(separated(joined(last.x) + d, last.x), last)

    def constraints(done: March):
        """(num_micro, r, n_g) at the nodes 1..r of the micro intervals."""
        slow_nodes = equations.q_s + _along(slow_basis_at_control_nodes(n, r)[:, 1:, 1:], done.x.slow)
        times = equations.t + h * (np.arange(n)[:, None] + control_nodes(r)[1:])
        return jax.vmap(jax.vmap(system.g))(times, slow_nodes, done.nodes)

    def joined(x: Unknowns):
        return jnp.concatenate([x.slow.reshape(-1), x.slow_multiplier.reshape(-1)])

    def separated(z, x: Unknowns) -> Unknowns:
        return x._replace(slow=z[: r * n_s].reshape(r, n_s), slow_multiplier=z[r * n_s :].reshape(r, -1))

    x = Unknowns(None, None, fast=jnp.zeros((n, r, n_f)), multiplier=jnp.zeros((n, r, n_g)))
    done = one_pass(separated(warm.slow.next(r * n_s), x))
    if linear:
        exact = np.zeros(()), np.zeros(())
        done = done._replace(residual=exact, passes=np.asarray(1), result=np.asarray(int(Result.CONVERGED)))
    else:
        done = newton.iterate(next_pass, done, done=1)
    if n_g:
        rows, g_slow = done.residual
        done = done._replace(residual=(rows, jnp.maximum(largest(constraints(done)), g_slow)))
    fewest = jnp.where(warm.passes[0] == UNKNOWN, done.passes, jnp.minimum(warm.passes[0], done.passes))
    slow, passes = warm.slow.add(joined(done.x), r * n_s), jnp.stack([fewest, done.passes])
    multiplier = warm.multiplier.after_step(done.x.multiplier / scale)
    bend = warm.bend if done.bends is None else warm.bend.after_step(done.bends)
    return done, Warm(slow, multiplier, bend, done.missed, passes)


def _along(weights, increments):
    """``sum_i weights_i increments_i`` over the last axis of weights and the first of increments."""
    return jnp.sum(weights[..., None] * increments, axis=-2)

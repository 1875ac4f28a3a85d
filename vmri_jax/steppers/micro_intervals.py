"""One pass over the micro intervals of a macro step: each corrected once, in order, for a given slow path."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vmri_jax.kernels import BandInverse, FullInverse, Sparsity, max_abs
from vmri_jax.mechanics.arrays import Numbers
from vmri_jax.schemes.discrete_lagrangian import Term, lagrangian
from vmri_jax.schemes.equations import StepEquations, slow_basis_at_control_nodes
from vmri_jax.schemes.path import control_nodes
from vmri_jax.steppers.interval import Matrix, constant_mass, interval_problem, weighted_sum


class SweepTotals(NamedTuple):
    """What a pass leaves, or what arrives at a micro interval in it.

    q_f, p_f: position and momentum times h at the end of the last interval.
    d_start, d_increments: gradients of h times the action by the start and by the increments of the slow path, without their
        kinetic energy.
    moved: largest correction of an increment.
    """

    q_f: Float[Numbers, "n_f"]
    p_f: Float[Numbers, "n_f"]
    d_start: Float[Array, "n_s"]
    d_increments: Float[Array, "r n_s"]
    moved: Float[Array, ""]


class FastUnknowns(NamedTuple):
    """Unknowns of the micro intervals and what is kept of them, with the intervals as first axis.

    increments, multiplier: the unknowns, multipliers scaled.
    schur_inverse: of ``G K^-1 G^T`` in the first pass.
    """

    increments: Float[Array, "num_micro r n_f"]
    multiplier: Float[Array, "num_micro r n_g"]
    schur_inverse: FullInverse | BandInverse


class MicroSweep(NamedTuple):
    """What is the same in all passes of a macro step.

    equations: of the macro step.
    is_explicit: whether fast increments follow from the multipliers, see `Interval`.
    matrix: K of the micro intervals.
    scale: what turns multipliers into unknowns.
    sparsity: of ``G K^-1 G^T`` of one interval.
    """

    equations: StepEquations
    is_explicit: bool
    matrix: Matrix
    scale: Float[Numbers, "num_micro r 1"]
    sparsity: Sparsity

    def first_pass(self, slow, multiplier) -> tuple[FastUnknowns, SweepTotals]:
        """With each interval's fast unknowns from a guess: straight motion, and the multipliers of the interval before.

        Args:
            slow: (r, n_s) increments of the slow path.
            multiplier: (r, n_g) multipliers lambda of the last interval of the step before.
        """
        r = self.equations.scheme.degree
        velocity = constant_mass(self.equations.system).fast_mass.inverse().times

        def interval(carry, at):
            (arriving, multiplier), (m, basis, scale) = carry, at
            straight = control_nodes(r)[1:, None] * velocity(arriving.p_f)
            done, totals = self._corrected(slow, arriving, m, basis, straight, scale * multiplier, self.sparsity)
            return (totals, done.multiplier / scale), done

        (totals, _), fast = jax.lax.scan(interval, (self._start(slow), multiplier), (*self._intervals(), self.scale))
        return fast, totals

    def next_pass(self, slow, fast: FastUnknowns) -> tuple[FastUnknowns, SweepTotals]:
        """With fast unknowns and small matrices of the pass before."""

        def interval(arriving, at):
            m, basis, before = at
            known = before.increments, before.multiplier, before.schur_inverse
            done, totals = self._corrected(slow, arriving, m, basis, *known)
            return totals, done

        totals, fast = jax.lax.scan(interval, self._start(slow), (*self._intervals(), fast))
        return fast, totals

    def _intervals(self):
        """Numbers of the intervals, and (n, r + 1, r) the slow positions at their nodes by slow increments."""
        n, r = self.equations.scheme.num_micro, self.equations.scheme.degree
        return jnp.arange(n), jnp.asarray(slow_basis_at_control_nodes(n, r)[..., 1:])

    def _start(self, slow) -> SweepTotals:
        equations = self.equations
        zero = jnp.zeros_like(equations.q_s), jnp.zeros_like(slow), jnp.zeros(())
        return SweepTotals(equations.q_f, equations.micro_dt * equations.p_f, *zero)

    def _corrected(
        self, slow, arriving: SweepTotals, m, basis, increments, mu, schur
    ) -> tuple[FastUnknowns, SweepTotals]:
        """Interval m, corrected once by a Newton step on its exact residual, and what it leaves."""
        equations, h, n = self.equations, self.equations.micro_dt, self.equations.scheme.num_micro
        q_s, steps = equations.q_s + weighted_sum(basis[0], slow), weighted_sum(basis[1:] - basis[0], slow)
        system, scheme = interval_problem(equations.system, equations.scheme)
        at_rest = jnp.zeros_like(q_s), jnp.zeros_like(arriving.q_f)
        local = StepEquations(system, scheme, equations.t + m * h, q_s, arriving.q_f, *at_rest, h)
        done = correct(local, steps, arriving.p_f, increments, mu, self.matrix, schur, self.is_explicit)

        d_start = arriving.d_start + done.d_start
        d_increments = arriving.d_increments + basis[0][:, None] * done.d_start
        d_increments += jnp.sum((basis[1:] - basis[0])[..., None] * done.d_steps[:, None], axis=0)
        q_f, p_f = arriving.q_f + done.increments[-1], done.p_f
        for term in lagrangian(system, scheme).kicks if n > 1 else ():  # where two micro intervals meet
            weight = jnp.where(m < n - 1, h * kick_weight(term, h), 0.0)
            d_s, d_f = term.gradient(equations.q_s + weighted_sum(basis[-1], slow), q_f)
            d_start, p_f = d_start + weight * d_s, p_f + weight * d_f
            d_increments += basis[-1][:, None] * (weight * d_s)
        for term in lagrangian(equations.system, equations.scheme).kicks:
            if term.every > 1:  # where two copies of its rule meet
                meets = ((m + 1) % term.every == 0) & (m < n - 1)
                weight = h * kick_weight(term, equations.macro_dt)
                d_s, d_f = _gradient_where(meets, term, equations.q_s + weighted_sum(basis[-1], slow), q_f)
                d_start, p_f = d_start + weight * d_s, p_f + weight * d_f
                d_increments += basis[-1][:, None] * (weight * d_s)

        totals = SweepTotals(q_f, p_f, d_start, d_increments, jnp.maximum(arriving.moved, done.moved))
        return FastUnknowns(done.increments, done.multiplier, done.schur_inverse), totals


def _gradient_where(condition, term: Term, q_s, q_f):
    """The gradient of a term, evaluated only if the condition holds, else zero."""
    return jax.lax.cond(condition, term.gradient, lambda *q: jax.tree.map(jnp.zeros_like, q), q_s, q_f)


def kick_weight(term: Term, h):
    """Of a kick where one interval ends and the next one starts, times its power of h."""
    return term.times_step(h) * sum(w for w in (term.start, term.end) if w is not None)


class Corrected(NamedTuple):
    """A micro interval after its correction.

    increments, multiplier: its unknowns.
    p_f: momentum times h that it hands on.
    d_start, d_steps: gradients of h times its action by the start and by the increments of its slow path.
    moved: largest correction of an increment.
    schur_inverse: of ``G_1 K^-1 G_0^T``.
    """

    increments: Float[Array, "r n_f"]
    multiplier: Float[Array, "r n_g"]
    p_f: Float[Array, "n_f"]
    d_start: Float[Array, "n_s"]
    d_steps: Float[Array, "r n_s"]
    moved: Float[Array, ""]
    schur_inverse: FullInverse | BandInverse


def correct(local: StepEquations, steps, p_f, increments, mu, matrix, schur, is_explicit: bool) -> Corrected:
    """One Newton step on the equations of one micro interval, with the residual R of its momentum equations,

        K dx - G_0^T dmu = -(R - G_0^T mu)        G_1 dx = -g

    by the Schur complement: first dx without dmu, then ``G_1 K^-1 G_0^T dmu = -(g + G_1 dx)``, then the part of dx that dmu makes.

    Args:
        local: its problem, from the positions at its start.
        steps: (r, n_s) increments of its slow path.
        p_f: momentum times h that arrives.
        increments, mu: (r, n_f), (r, n_g) its unknowns so far; explicit increments follow from mu.
        matrix: K.
        schur: inverse of ``G_1 K^-1 G_0^T``; or its sparsity, with which the inverse is computed here.
    """
    system, (r, n_g) = local.system, mu.shape
    times = local.t + local.macro_dt * control_nodes(r)
    slow_nodes = jnp.concatenate([local.q_s[None], local.q_s + steps])
    fast_nodes = jnp.concatenate([local.q_f[None], local.q_f + increments[:-1]])
    pull = jax.vjp(partial(jax.vmap(system.g), times[:-1]), slow_nodes[:-1], fast_nodes)[1]  # G_0^T
    pull_s, pull_f = pull(mu)
    if is_explicit:
        increments = -matrix.solve(p_f - pull_f)

    def gradient(increments):
        path = local.path_of(steps, increments[None])
        return jax.grad(local.without_kinetic)(path, path)

    d, change = jax.linearize(gradient, increments)
    d_fast = d.fast[0] + lagrangian(system, local.scheme).kinetic.rows(steps, increments)[1]
    g, push = jax.linearize(lambda x: jax.vmap(system.g)(times[1:], slow_nodes[1:], local.q_f + x), increments)
    dx, g_then = jnp.zeros_like(increments), g
    if not is_explicit:
        rows = jnp.concatenate([(d.fast_start - d_fast.sum(0)) + p_f, d_fast[:-1]])
        dx = -matrix.solve(rows - pull_f)
        g_then = g + push(dx)
    if isinstance(schur, Sparsity):
        seeds = schur.seeds
        products = jax.vmap(lambda seed: push(matrix.solve(pull(seed)[1])))(seeds.reshape(len(seeds), r, n_g))
        schur = schur.inverse(products.reshape(seeds.shape))
    dmu = -schur.times(g_then.reshape(-1)).reshape(r, n_g)
    more_s, more_f = pull(dmu)
    if n_g:
        dx += matrix.solve(more_f)

    coupling, impulse = change(dx), -(pull_s + more_s)
    later = jnp.concatenate([impulse[1:], jnp.zeros_like(impulse[:1])])
    return Corrected(
        increments + dx,
        mu + dmu,
        p_f=d_fast[-1] + matrix.outgoing(dx),
        d_start=d.slow_start + coupling.slow_start + impulse.sum(0),
        d_steps=d.slow + coupling.slow + later,
        moved=max_abs(dx),
        schur_inverse=schur,
    )

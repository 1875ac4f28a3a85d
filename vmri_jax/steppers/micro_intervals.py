"""One pass over the micro intervals of a macro step: every interval is corrected once, in order, with the slow path held fixed."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vmri_jax.kernels import max_abs
from vmri_jax.kernels.band import BandInverse, FullInverse, Sparsity
from vmri_jax.mechanics.arrays import Numbers
from vmri_jax.schemes.discrete_lagrangian import TermOnNodes, lagrangian
from vmri_jax.schemes.equations import StepEquations, slow_basis_at_control_nodes
from vmri_jax.schemes.path import control_nodes
from vmri_jax.steppers.interval import Matrix, constant_mass, interval_problem, weighted_sum
from vmri_jax.steppers.solver import only_if


class SweepTotals(NamedTuple):
    """Quantities that a pass accumulates over the micro intervals; they arrive at the next interval, and at last at the slow equations.

    q_f, p_f: position and momentum times h at the end of the last interval.
    d_start, d_increments: gradients of h times the action with respect to the start and the increments of the slow path, without the slow
        kinetic energy.
    moved: largest correction of a fast increment.
    """

    q_f: Float[Numbers, "n_f"]
    p_f: Float[Numbers, "n_f"]
    d_start: Float[Array, "n_s"]
    d_increments: Float[Array, "r n_s"]
    moved: Float[Array, ""]


class FastUnknowns(NamedTuple):
    """Unknowns of one micro interval, or of all with the intervals as first axis, and the matrix that corrects the multipliers.

    increments, multiplier: fast increments, and scaled multipliers mu.
    schur_inverse: ``S = (G_1 K^-1 G_0^T)^-1`` of the first pass, kept in the later ones.
    """

    increments: Float[Array, "*num_micro r n_f"]
    multiplier: Float[Array, "*num_micro r n_g"]
    schur_inverse: FullInverse | BandInverse


class MicroSweep(NamedTuple):
    """The quantities that all passes of a macro step share.

    equations: of the macro step.
    is_explicit: whether fast increments are explicit functions of the multipliers, see `Interval`.
    matrix: K of the micro intervals.
    scale: factor ``mu / lambda`` of the scaled multipliers.
    sparsity: of ``G K^-1 G^T`` of one interval.
    """

    equations: StepEquations
    is_explicit: bool
    matrix: Matrix
    scale: Float[Numbers, "num_micro r 1"]
    sparsity: Sparsity

    def unsolved(self) -> FastUnknowns:
        """The fast unknowns before the first pass."""
        equations, seeds = self.equations, self.sparsity.seeds
        r, (n_g, _) = equations.scheme.degree, equations.system.num_constraints(equations.q_s, equations.q_f)
        schur_inverse = jax.eval_shape(self.sparsity.inverse, seeds)
        of_interval = FastUnknowns(jnp.zeros((r, equations.q_f.size)), jnp.zeros((r, n_g)), schur_inverse)
        return jax.tree.map(lambda a: jnp.zeros((equations.scheme.num_micro, *a.shape), a.dtype), of_interval)

    def corrected(self, slow, fast: FastUnknowns, multiplier, is_first) -> tuple[FastUnknowns, SweepTotals]:
        """A pass. In the first one every interval starts from straight motion at the momentum that arrives, with the multipliers of the interval before.

        Args:
            slow: (r, n_s) increments of the slow path.
            fast: unknowns of the pass before.
            multiplier: (r, n_g) multipliers lambda of the last interval of the step before.
            is_first: whether this is the first pass.
        """
        r = self.equations.scheme.degree
        velocity = constant_mass(self.equations.system).fast_mass.inverse().times

        def interval(carry, numbers):
            (arriving, multiplier), (m, basis, scale, before) = carry, numbers
            straight = control_nodes(r)[1:, None] * velocity(arriving.p_f)  # c_j h M^-1 p_f
            guess = before._replace(
                increments=jnp.where(is_first, straight, before.increments),
                multiplier=jnp.where(is_first, scale * multiplier, before.multiplier),
            )
            unknowns, totals = self._corrected(slow, arriving, m, basis, guess, is_first)
            return (totals, unknowns.multiplier / scale), unknowns

        (totals, _), fast = jax.lax.scan(
            interval, (self.start(slow), multiplier), (*self._intervals(), self.scale, fast)
        )
        return fast, totals

    def _intervals(self):
        """Numbers m of the intervals, and the basis (n, r + 1, r) of the slow path at their nodes, by slow increments."""
        n, r = self.equations.scheme.num_micro, self.equations.scheme.degree
        return jnp.arange(n), jnp.asarray(slow_basis_at_control_nodes(n, r)[..., 1:])

    def start(self, slow) -> SweepTotals:
        equations = self.equations
        zero = jnp.zeros_like(equations.q_s), jnp.zeros_like(slow), jnp.zeros(())
        return SweepTotals(equations.q_f, equations.micro_dt * equations.p_f, *zero)

    def _corrected(
        self, slow, arriving: SweepTotals, m, basis, guess: FastUnknowns, is_first
    ) -> tuple[FastUnknowns, SweepTotals]:
        """Interval m, corrected once by a Newton step on its exact residual, and the totals after it."""
        equations, h, n = self.equations, self.equations.micro_dt, self.equations.scheme.num_micro
        q_s, steps = equations.q_s + weighted_sum(basis[0], slow), weighted_sum(basis[1:] - basis[0], slow)
        system, scheme = interval_problem(equations.system, equations.scheme)
        at_rest = jnp.zeros_like(q_s), jnp.zeros_like(arriving.q_f)
        local = StepEquations(system, scheme, equations.t + m * h, q_s, arriving.q_f, *at_rest, h)
        unknowns, p_f, d_start, d_steps, moved = correct(self, local, steps, arriving.p_f, guess, is_first)

        # Chain rule: with the slow increments S of the macro step and the rows b_j of the basis, the slow path of this interval starts
        # at q_s + b_0 S and has the increments (b_j - b_0) S.
        d_increments = arriving.d_increments + basis[0][:, None] * d_start
        d_increments += jnp.sum((basis[1:] - basis[0])[..., None] * d_steps[:, None], axis=0)
        d_start, q_f = arriving.d_start + d_start, arriving.q_f + unknowns.increments[-1]
        # Kicks ``p_f <- p_f + h w dL/dq_f`` at the node where this interval ends and the next one starts; those at the end of the macro
        # step are taken outside.
        end = equations.q_s + weighted_sum(basis[-1], slow), q_f
        kicks = []  # weights and gradients
        for term in lagrangian(system, scheme).kicks if n > 1 else ():
            kicks.append((jnp.where(m < n - 1, h * kick_weight(term, h), 0.0), term.gradient(*end)))
        for term in lagrangian(equations.system, equations.scheme).kicks:
            if term.every > 1:  # only at the nodes where two copies of the rule meet
                meets = ((m + 1) % term.every == 0) & (m < n - 1)
                gradient = jax.lax.cond(meets, term.gradient, lambda *q: jax.tree.map(jnp.zeros_like, q), *end)
                kicks.append((h * kick_weight(term, equations.macro_dt), gradient))
        for weight, (d_s, d_f) in kicks:
            d_start, p_f = d_start + weight * d_s, p_f + weight * d_f
            d_increments += basis[-1][:, None] * (weight * d_s)

        totals = SweepTotals(q_f, p_f, d_start, d_increments, jnp.maximum(arriving.moved, moved))
        return unknowns, totals


def kick_weight(term: TermOnNodes, h):
    """Weight of a kick at a node where one interval ends and the next one starts, times the power of h of the term."""
    return term.times_step(h) * sum(w for w in (term.start, term.end) if w is not None)


def correct(sweep: MicroSweep, local: StepEquations, steps, p_f, guess: FastUnknowns, is_first):
    """One Newton step on the equations of one micro interval, for the fast increments x and the multipliers mu,

        K dx - G_0^T dmu = -R        R = rows - G_0^T mu        G_1 dx = -g

    where R is the residual of the momentum equations, `rows` its part without constraint forces, and G_0, G_1 the Jacobians of g at the
    nodes 0..r-1 and 1..r. Solved by the Schur complement: first dx without dmu, then ``G_1 K^-1 G_0^T dmu = -(g + G_1 dx)``, then
    dx with dmu.

    Args:
        sweep: K, the sparsity of the Schur complement, and whether the increments are explicit functions of mu.
        local: the interval as a problem of its own, from the positions at its start.
        steps: (r, n_s) increments of the slow path over the interval.
        p_f: momentum times h that arrives.
        guess: unknowns before the correction.
        is_first: whether this is the first pass, which computes S.

    Returns:
        (unknowns with S, p_f times h at the end, gradients of h times the action with respect to the start and the increments of the slow path,
        largest correction of a fast increment).
    """
    (increments, mu, schur), matrix = guess, sweep.matrix
    system, (r, n_g) = local.system, mu.shape
    times = local.t + local.macro_dt * control_nodes(r)
    slow_nodes = jnp.concatenate([local.q_s[None], local.q_s + steps])
    fast_nodes = jnp.concatenate([local.q_f[None], local.q_f + increments[:-1]])
    pull = jax.vjp(partial(jax.vmap(system.g), times[:-1]), slow_nodes[:-1], fast_nodes)[1]  # G_0^T
    pull_s, pull_f = pull(mu)
    # K x = -(h p_f - G_0^T mu): the momentum equations hold exactly, and only the constraints have a residual
    if sweep.is_explicit:
        increments = -matrix.solve(p_f - pull_f)

    def gradient(increments):
        path = local.path_of(steps, increments[None])
        return jax.grad(local.without_kinetic)(path, path)

    # d: gradients of h times the action of the interval, without kinetic energy and constraints; change: their derivative with respect to x
    d, change = jax.linearize(gradient, increments)
    d_fast = d.fast[0] + lagrangian(system, local.scheme).kinetic.fast_rows(increments)
    g, push = jax.linearize(lambda x: jax.vmap(system.g)(times[1:], slow_nodes[1:], local.q_f + x), increments)
    dx, g_after_dx = jnp.zeros_like(increments), g
    if not sweep.is_explicit:
        # momentum equations at the nodes 0..r-1: h p_f + h D_{F_0} L, h D_{F_j} L
        rows = jnp.concatenate([(d.fast_start - d_fast.sum(0)) + p_f, d_fast[:-1]])
        dx = matrix.solve(pull_f - rows)
        g_after_dx += push(dx)

    def schur_inverse(_):
        seeds = sweep.sparsity.seeds
        columns = jax.vmap(lambda seed: pull(seed)[1])(seeds.reshape(len(seeds), r, n_g))
        return sweep.sparsity.inverse(jax.vmap(push)(jax.vmap(matrix.solve)(columns)).reshape(seeds.shape))

    if n_g:
        schur = only_if(is_first, schur_inverse, schur)
    # dmu = -S (g + G_1 dx), then dx <- dx + K^-1 G_0^T dmu
    dmu = -schur.times(g_after_dx.reshape(-1)).reshape(r, n_g)
    pull_dmu_s, pull_dmu_f = pull(dmu)
    if n_g:
        dx += matrix.solve(pull_dmu_f)

    # gradients at x + dx to first order, and the constraint impulses -G_s^T (mu + dmu) at the nodes 0..r-1
    coupling, impulse = change(dx), -(pull_s + pull_dmu_s)
    later = jnp.concatenate([impulse[1:], jnp.zeros_like(impulse[:1])])
    d_start, d_steps = d.slow_start + coupling.slow_start + impulse.sum(0), d.slow + coupling.slow + later
    # The momentum at the end is the start momentum plus all impulses, h p_f + h D_{F_0} L + ... + h D_{F_r} L. At the root that is h D_{F_r} L; but
    # an error e of x, below the round-off of the positions, would change that by M e, and does not change the impulses of the inertia.
    p_f += (d.fast_start + coupling.fast_start)[0] - (pull_f + pull_dmu_f).sum(0)
    return FastUnknowns(increments + dx, mu + dmu, schur), p_f, d_start, d_steps, max_abs(dx)

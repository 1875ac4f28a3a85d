"""One pass over the micro intervals of a macro step: every interval is corrected once, in order, with the slow path
held fixed."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vmri_jax.kernels import max_abs
from vmri_jax.kernels.band import BandInverse, FullInverse
from vmri_jax.mechanics.arrays import Numbers
from vmri_jax.schemes.intervals import Arriving, Intervals
from vmri_jax.schemes.path import control_nodes
from vmri_jax.steppers.interval import IntervalStructure, Matrix
from vmri_jax.steppers.solver import only_if


class FastUnknowns(NamedTuple):
    """Unknowns of one micro interval, or of all with the intervals as first axis, and the matrix that corrects the
    multipliers.

    increments, multiplier: fast increments, and scaled multipliers mu.
    schur_inverse: ``S = (G_1 K^-1 G_0^T)^-1`` of the first pass, kept in the later ones.
    """

    increments: Float[Array, "*num_micro r n_f"]
    multiplier: Float[Array, "*num_micro r n_g"]
    schur_inverse: FullInverse | BandInverse


class MicroSweep(NamedTuple):
    """The quantities that all passes of a macro step share.

    intervals: the equations.
    structure: of an interval.
    matrix: K of the micro intervals.
    scale: factor ``mu / lambda`` of the scaled multipliers.
    multiplier: multipliers lambda of the last interval of the step before.
    """

    intervals: Intervals
    structure: IntervalStructure
    matrix: Matrix
    scale: Float[Numbers, "num_micro r 1"]
    multiplier: Float[Array, "r n_g"]

    def blank(self) -> FastUnknowns:
        """The fast unknowns before the first pass."""
        equations, sparsity = self.intervals.equations, self.structure.of_constraints
        schur_inverse = jax.eval_shape(sparsity.inverse, sparsity.seeds)
        increments = jnp.zeros((equations.scheme.degree, equations.q_f.size))
        of_interval = FastUnknowns(increments, jnp.zeros_like(self.multiplier), schur_inverse)
        return jax.tree.map(lambda a: jnp.zeros((equations.scheme.num_micro, *a.shape), a.dtype), of_interval)

    def corrected(self, slow, fast: FastUnknowns, is_first) -> tuple[FastUnknowns, Arriving, Float[Array, ""]]:
        """A pass. In the first one every interval starts from straight motion at the momentum that arrives, with the
        multipliers of the interval before.

        Args:
            slow: (r, n_s) increments of the slow path.
            fast: unknowns of the pass before.
            is_first: whether this is the first pass.

        Returns:
            The unknowns, the quantities that the last interval hands on, and the largest correction of a fast
            increment.
        """
        equations, r = self.intervals.equations, self.intervals.equations.scheme.degree
        velocity = equations.system.kinetic.fast_mass.inverse().times
        seen = self.intervals.seen.take(slow)

        def interval(carry, numbers):
            (arriving, multiplier, worst), (m, scale, before) = carry, numbers
            straight = control_nodes(r)[1:, None] * velocity(arriving.p_f)  # c_j h M^-1 p_f
            # sums, since the unknowns before the first pass are zero: a selection costs a batch a quarter of its time
            guess = before._replace(
                increments=before.increments + is_first * straight,
                multiplier=before.multiplier + is_first * scale * multiplier,
            )
            unknowns, arriving, moved = self._corrected(m, guess, arriving, seen, is_first)
            return (arriving, unknowns.multiplier / scale, jnp.maximum(worst, moved)), unknowns

        start = self.intervals.start(), self.multiplier, jnp.zeros(())
        (end, _, moved), fast = jax.lax.scan(
            interval, start, (jnp.arange(equations.scheme.num_micro), self.scale, fast)
        )
        return fast, end, moved

    def _corrected(self, m, guess: FastUnknowns, arriving: Arriving, slow, is_first):
        """One Newton step on the equations of interval m, for the fast increments x and the multipliers mu,

            K dx - G_0^T dmu = -R        R = rows - G_0^T mu        G_1 dx = -g

        where R is the residual of the momentum equations, `rows` its part without constraint forces, and G_0, G_1 the
        Jacobians of g at the nodes 0..r-1 and 1..r. Solved by the Schur complement: first dx without dmu, then
        ``G_1 K^-1 G_0^T dmu = -g`` with g at x + dx, then dx with dmu.

        Args:
            guess: unknowns before the correction.
            arriving: from the intervals before.
            slow: (r, n_v) increments of the slow path that are seen.
            is_first: whether this is the first pass, which computes S.

        Returns:
            (unknowns, the quantities that are handed on, largest correction of a fast increment).
        """
        (x, mu, schur), intervals, solve = guess, self.intervals, self.matrix.solve
        if self.structure.is_explicit:  # K is exact: the increments follow from the multipliers, wherever they start
            x = jnp.zeros_like(x)
        path = intervals.path(arriving, slow, x)
        pull = intervals.constraint_impulses(m, path)  # G_0^T
        # gradient of h times the action without kinetic energy and constraints, and the change of it with x
        d, change = jax.linearize(lambda x: intervals.gradient(m, path._replace(fast=x)), x)
        d = jax.tree.map(jnp.subtract, d, pull(mu))
        dx = -solve(intervals.rows(intervals.with_inertia(d, x), arriving.p_f))
        if self.structure.is_explicit:  # the correction is that of the multipliers, below
            x, dx = dx, x
        if mu.size:
            g, push = jax.linearize(lambda x: intervals.constraints(path._replace(fast=x), m, slice(1, None)), x + dx)

            def schur_inverse(_):
                sparsity = self.structure.of_constraints
                seeds = sparsity.seeds
                columns = jax.vmap(lambda seed: push(solve(intervals.rows(pull(seed)))))(seeds.reshape(-1, *mu.shape))
                return sparsity.inverse(columns.reshape(seeds.shape))

            schur = only_if(is_first, schur_inverse, schur)
            dmu = -schur.times(g.reshape(-1)).reshape(mu.shape)
            impulses = pull(dmu)
            dx, mu = dx + solve(intervals.rows(impulses)), mu + dmu
            d = jax.tree.map(jnp.subtract, d, impulses)
        # gradients at x + dx to first order
        d = jax.tree.map(jnp.add, d, change(dx))
        on = intervals.handed_on(arriving, d, x[-1] + dx[-1])
        return FastUnknowns(x + dx, mu, schur), on, max_abs(dx)

"""The march: a macro step of any Lagrangian, micro interval by micro interval.

A micro interval is a map ``(q_f, p_f, slow path) -> (q_f, p_f, impulses on the slow path)``, given by its equations R_m
= 0 for its unknowns x_m (`vmri_jax.schemes.intervals`). The macro step has the unknowns x_m of all intervals, and z:
slow increments and slow multipliers.

A pass goes over the intervals in order. Each interval corrects its unknowns once, and hands on its end position,
momentum and impulses, corrected to first order:

    d_m = -(dR_m/dx_m)^-1 R_m        x_m <- x_m + d_m

After the last interval the pass computes a correction of z by the slow equations R_s = 0, which the impulses of all
intervals enter; the next pass starts with it,

    d = -S^-1 R_s                    z <- z + d,    x_m <- x_m + (dx_m/dz) d

with S the total derivative of R_s by z, the Schur complement of the intervals: z acts on R_s itself, and through all
x_m.

The matrices, the derivatives of the intervals in forward mode, come from a pass that computes them (`linearised_pass`).
It carries along how x_m and the numbers that are handed on change with z, so that S is known at the end. They are
exact, or of the *masses*: with the quadratic form ``v^T M v / 2`` in place of a kinetic energy T that is a function,
``M = d2T/dv2`` at the start of the step. The residual is exact in both cases, so that the matrices change only the
number of passes. Passes keep all matrices, also those of the steps before, while the corrections shrink, and cost one
gradient of the action each.

This module remembers nothing from step to step: the guess and the kept matrices come from `vmri_jax.steppers.marched`.
"""

from copy import copy
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vmri_jax.kernels import FEWEST_IN_PARTS, matmul, matvec, max_abs
from vmri_jax.mechanics.arrays import split_at
from vmri_jax.schemes.equations import StepEquations, Unknowns
from vmri_jax.schemes.intervals import Arriving, Intervals, IntervalUnknowns
from vmri_jax.steppers.accept import NO_WEIGHTS, Weights, largest
from vmri_jax.steppers.null_space import inverse_with_multipliers


class Matrices(NamedTuple):
    """The matrices, which passes keep: k unknowns of an interval, r n_v slow increments that it sees.

    inverse: ``(dR/dx)^-1`` of the residual R of an interval by its unknowns x.
    hands_on: derivative of the o gradients that are handed on (`FlatArriving`) by these unknowns.
    response: ``dx_m/dz``, for the slow increments that intervals see.
    slow: ``S^-1``, the inverse of the slow equations after elimination of the intervals.
    """

    inverse: Float[Array, "num_micro k k"]
    hands_on: Float[Array, "num_micro o k"]
    response: Float[Array, "num_micro k r*n_v"]
    slow: Float[Array, "b b"]


class FlatArriving(NamedTuple):
    """`Arriving` as two vectors, or their derivatives, as matrices with one column for each direction.

    position: q_f.
    gradients: of h times the action of the intervals before: by q_f (the momentum ``h p_f``), by the start of the slow
        path, by its increments.
    """

    position: Float[Array, "n_f ..."]
    gradients: Float[Array, "o ..."]


class MarchEquations:
    """The equations of a macro step with unknowns in rows: x (num_micro, k) of the intervals, z (b,) of the slow path.

    Args:
        equations: of the macro step.
        inverted: function of (A, B, C, number of nodes) that inverts the matrix ``[[A, B], [C, 0]]``.
        weights: of the variables, for the sizes of corrections and residuals.
    """

    def __init__(self, equations: StepEquations, inverted=inverse_with_multipliers, weights: Weights = NO_WEIGHTS):
        self.equations, self.intervals = equations, Intervals(equations)
        self.weights = weights
        self.of_increments = Weights(*(w if w is None else jnp.tile(w, equations.scheme.degree) for w in weights))
        self.of_momenta = self.of_increments.of_momenta()
        self.inverted = inverted
        self.n, self.r = equations.scheme.num_micro, equations.scheme.degree
        self.n_s, self.n_f = equations.q_s.size, equations.q_f.size
        self.n_g, self.n_gs = equations.system.num_constraints(equations.q_s, equations.q_f)
        self.n_v = self.intervals.seen.count  # the slow variables that intervals see
        self.num_fast, self.num_slow, self.num_seen = self.r * self.n_f, self.r * self.n_s, self.r * self.n_v

    @property
    def has_slow_path(self) -> bool:
        """Whether there are slow unknowns, or several intervals; else the unknowns of one interval are all."""
        return self.n > 1 or self.num_slow + self.n_gs > 0

    def predicted(self, z, x):
        """The unknowns that steps before predict, z or those of the only interval, and how many of them are
        increments."""
        return (z, self.num_slow) if self.has_slow_path else (x[0], self.num_fast)

    def by_masses(self) -> "MarchEquations":
        """The equations with the quadratic form of the masses in place of a kinetic energy that is a function."""
        march = copy(self)
        march.intervals = self.intervals.by_masses()
        if self.n_s + self.n_f >= FEWEST_IN_PARTS:
            march.inverted = partial(inverse_with_multipliers, inverted=jnp.linalg.inv)
        return march

    def flat(self, x: Unknowns):
        """The unknowns as arrays z (b,) and x (num_micro, k)."""
        z = jnp.concatenate([x.slow.reshape(-1), x.slow_multiplier.reshape(-1)])
        return z, jnp.concatenate([x.fast.reshape(self.n, -1), x.multiplier.reshape(self.n, -1)], axis=1)

    def by_name(self, z, x) -> Unknowns:
        """The inverse of `flat`."""
        fast, multiplier = (part.reshape(self.n, self.r, -1) for part in split_at(x, self.num_fast))
        return Unknowns(*self._slow_by_name(z), fast, multiplier)

    def _slow_by_name(self, z):
        """The slow increments (r, n_s) and multipliers (r, n_gs) in z."""
        slow, multiplier = split_at(z, self.num_slow)
        return slow.reshape(self.r, self.n_s), multiplier.reshape(self.r, self.n_gs)

    def slow_size(self, z):
        """Largest slow increment in z, or in its correction."""
        return largest(z[: self.num_slow], self.of_increments.slow)

    def fast_size(self, x):
        """Largest fast increment in the unknowns (..., k) of intervals, or in their corrections."""
        return largest(x[..., : self.num_fast], self.of_increments.fast)

    def seen(self, z):
        """(r n_v,) the slow increments in z that intervals see."""
        return self.intervals.seen.take(z[: self.num_slow].reshape(self.r, self.n_s)).reshape(self.num_seen)

    def start(self) -> FlatArriving:
        """The fast position and momentum at the start of the step; no interval has pushed the slow path yet."""
        start = self.intervals.start()
        return FlatArriving(start.q_f, _gradients(start))

    def no_matrices(self) -> Matrices:
        """Matrices of zeros, for their shapes."""
        n, k, o = self.n, self.num_fast + self.r * self.n_g, self.n_f + self.n_v + self.num_seen
        b = self.num_slow + self.r * self.n_gs
        return Matrices(*map(jnp.zeros, ((n, k, k), (n, o, k), (n, k, self.num_seen), (b, b))))

    def interval(self, m, x, arriving: FlatArriving, slow):
        """Residual (k,) of interval m, and the gradients (o,) that it hands on."""
        residual, on = self.intervals.evaluate(m, self._named(x), self._apart(arriving), slow.reshape(self.r, self.n_v))
        rows = jnp.concatenate([residual.fast.reshape(-1), residual.multiplier.reshape(-1)])
        return rows, _gradients(on)

    def _named(self, x) -> IntervalUnknowns:
        fast, multiplier = split_at(x, self.num_fast)
        return IntervalUnknowns(fast.reshape(self.r, self.n_f), multiplier.reshape(self.r, self.n_g))

    def slow_equations(self, z, arriving: FlatArriving):
        """Residual (b,) of the slow equations, and the slow momentum at the end."""
        slow, multiplier = self._slow_by_name(z)
        impulses = self.intervals.slow_impulses(slow, multiplier)
        rows, p_s = self.intervals.slow_rows(slow, impulses, self._apart(arriving))
        return jnp.concatenate([rows.reshape(-1), self.intervals.slow_constraints(slow).reshape(-1)]), p_s

    def _apart(self, arriving: FlatArriving) -> Arriving:
        p_f, start, slow = split_at(arriving.gradients, self.n_f, self.n_f + self.n_v)
        return Arriving(arriving.position, p_f, start, slow.reshape(self.r, self.n_v))

    def slow_inverse(self, z, arriving: FlatArriving, sensitivities: FlatArriving):
        """The inverse (b, b) of the total derivative S of the slow residual, and `slow_equations`, whose values it
        shares.

        Args:
            sensitivities: derivative of `arriving` with respect to the slow increments, one column for each increment
                that intervals see.
        """
        (residual, p_s), push = jax.linearize(self.slow_equations, z, arriving)

        # zero columns for the slow increments that no interval sees and for the slow multipliers: they do not change
        # `arriving`
        def for_all(sensitivity):
            none = jnp.zeros((len(sensitivity), self.r, self.n_s))
            seen = self.intervals.seen.put(sensitivity.reshape(len(sensitivity), self.r, self.n_v), none)
            return jnp.pad(seen.reshape(len(sensitivity), self.num_slow), [(0, 0), (0, z.size - self.num_slow)])

        sensitivities = jax.tree.map(for_all, sensitivities)
        # column j of S: dR_s/dz e_j + dR_s/d(arriving) d(arriving)/dz_j
        matrix = jax.vmap(push, in_axes=-1, out_axes=-1)(jnp.eye(z.size), sensitivities)[0]
        return self.inverse(matrix, self.num_slow), (residual, p_s)

    def inverse(self, matrix, size: int):
        """The inverse of a matrix whose first `size` unknowns are increments, and the remaining ones multipliers."""
        return self.inverted(matrix[:size, :size], matrix[:size, size:], matrix[size:, :size], self.r)

    def last_increment(self, x):
        """The fast increment (n_f, ...) from the start of the interval to its end, out of the unknowns (k, ...)."""
        return x[self.num_fast - self.n_f : self.num_fast]

    def corrected(
        self, m, matrices, x, slow, arriving: FlatArriving, values, worst: "Worst"
    ) -> tuple[Any, FlatArriving, "Worst"]:
        """Interval m after the correction ``d = -(dR/dx)^-1 R``: x + d, its end position and gradients, corrected to
        first order, and the maxima.

        The impulses of constraints are taken at x itself. Kept matrices would give them a direction of earlier
        positions, and the multipliers follow the round-off of the constraints: momenta would get errors that no
        projection onto the hidden constraints removes.

        Args:
            matrices: ``(dR/dx)^-1``, and the derivative of the gradients that are handed on.
            values: of `interval`.
            worst: maxima over the intervals before.
        """
        (inverse, hands_on), (residual, gradients), n = matrices, values, self.num_fast
        d = -matvec(inverse, residual)
        gradients += matvec(hands_on[:, :n], d[:n])
        if self.n_g:
            dmu = self._named(d).multiplier
            named = self._named(x), self._apart(arriving), slow.reshape(self.r, self.n_v)
            gradients += _gradients(self.intervals.impulses(m, *named, dmu))
        worst = worst.add(residual, d, largest(residual[:n], self.of_momenta.fast), self.fast_size(d))
        return x + d, FlatArriving(arriving.position + self.last_increment(x + d), gradients), worst

    def passed(self, matrices: Matrices, z, x, worst: "Worst", end: FlatArriving, slow_values) -> "Passed":
        """The pass after its last interval: the slow correction ``dz = -S^-1 R_s``, and ``dx_m = (dx_m/dz) dz``.

        The returned z and p_s contain the correction of the slow multipliers already, dz the correction of the
        increments alone.

        Args:
            matrices: of this pass or kept ones.
            z, x: unknowns, x corrected by the pass.
            worst: maxima over the intervals.
            end: the quantities that the last interval hands on.
            slow_values: of `slow_equations`.
        """
        residual, p_s = slow_values
        dz = -matvec(matrices.slow, residual)
        dx = jnp.sum(matrices.response * self.seen(dz), axis=-1)
        rows = largest(residual[: self.num_slow], self.of_momenta.slow)
        worst = worst.add(residual, dz, rows, worst.moved)
        if self.n_gs:
            # Slow multipliers take their correction in this pass, as those of the intervals: a step at rest has no
            # other pass.
            slow, dnu = z[: self.num_slow].reshape(self.r, self.n_s), dz[self.num_slow :]
            z, dz = z.at[self.num_slow :].add(dnu), dz.at[self.num_slow :].set(0.0)
            p_s -= self.intervals.slow_impulses(slow, dnu.reshape(self.r, self.n_gs)).sum(0) / self.equations.micro_dt
        return Passed(z, x, dz, dx, end, p_s, worst)


def _gradients(on: Arriving):
    """(o,) the gradients in one vector."""
    return jnp.concatenate([on.p_f, on.start, on.slow.reshape(-1)])


class Worst(NamedTuple):
    """Maxima over the intervals of a pass.

    moved: largest correction of a fast increment.
    rows: largest residual of the momentum equations before the corrections, times h.
    is_singular: whether a finite residual had a correction that is not finite.
    """

    moved: Float[Array, ""]
    rows: Float[Array, ""]
    is_singular: Bool[Array, ""]

    @classmethod
    def none(cls) -> "Worst":
        """The value before the first interval."""
        return cls(jnp.zeros(()), jnp.zeros(()), jnp.asarray(False))

    def add(self, residual, correction, rows, moved) -> "Worst":
        """The maxima with one more interval included.

        Args:
            residual, correction: of the interval (or of the slow equations).
            rows: largest residual of its momentum equations.
            moved: largest correction of a fast increment in it.
        """
        singular = jnp.isfinite(max_abs(residual)) & ~jnp.isfinite(max_abs(correction))
        return Worst(jnp.maximum(self.moved, moved), jnp.maximum(self.rows, rows), self.is_singular | singular)


class Passed(NamedTuple):
    """The unknowns after a pass, and the slow correction with which the next pass begins.

    z, x: unknowns, x and the slow multipliers in z corrected by the pass.
    dz, dx: correction of the slow increments in z, and the change of x that follows from it.
    end, p_s: the quantities that the last interval hands on, and the slow momentum at the end of the step.
    """

    z: Float[Array, "b"]
    x: Float[Array, "num_micro k"]
    dz: Float[Array, "b"]
    dx: Float[Array, "num_micro k"]
    end: FlatArriving
    p_s: Float[Array, "n_s"]
    worst: Worst


def linearised_pass(
    march: MarchEquations, z, x, last, from_last, corrects: bool = True
) -> tuple[Matrices, Passed, list]:
    """A pass that computes the matrices at its unknowns: ``dR/d(z, x)`` after block elimination of the intervals.

    Args:
        march: the equations.
        z, x: unknowns.
        last: (k,) unknowns of the last interval of the step before.
        from_last: whether each interval starts from the unknowns of the interval before, instead of its unknowns in x.
        corrects: whether every interval starts from the corrected end of the interval before, so that far from the
            solution the matrices are those of a path that is closer to it; else the matrices are those of z and x.

    Returns:
        The matrices, the pass, and the derivatives (num_micro, k, n_f) and (num_micro, o, n_f) of the residual of every
        interval and of the gradients that it hands on, with respect to the position that arrives, for `implicit.solve`.
    """
    slow, unit, n_f = march.seen(z), jnp.eye(march.num_seen), march.n_f

    def interval(carry, unknowns):
        (arriving, sensitivities, last, worst), (m, x) = carry, unknowns
        x = jnp.where(from_last, last, x)
        values, push = jax.linearize(partial(march.interval, m), x, arriving, slow)

        # Columns: the unknowns of the interval, the slow increments together with the sensitivities d(arriving)/dz of
        # the intervals before, and the arriving position alone. One vmap for all of them: the tangents of the action
        # are most of the program, and each call compiles them.
        ends = x.size, x.size + march.num_seen
        by_unknowns = jnp.eye(x.size, ends[1] + n_f)
        by_arriving, by_slow = jax.tree.map(lambda a: jnp.pad(a, ((0, 0), (x.size, n_f))), (sensitivities, unit))
        by_arriving = by_arriving._replace(position=by_arriving.position.at[:, ends[1] :].set(jnp.eye(n_f)))
        by_all = jax.vmap(push, in_axes=-1, out_axes=-1)(by_unknowns, by_arriving, by_slow)
        by_parts = (split_at(a, *ends) for a in by_all)
        (by_x, by_z, by_position), (hands_on, hands_on_by_z, hands_on_by_position) = by_parts
        inverse = march.inverse(by_x, march.num_fast)
        # dx_m/dz = -(dR_m/dx_m)^-1 dR_m/dz, with the dependence of the arriving quantities on z inside dR_m/dz
        response = -matmul(inverse, by_z)
        sensitivities = FlatArriving(
            sensitivities.position + march.last_increment(response), hands_on_by_z + matmul(hands_on, response)
        )
        if corrects:
            x, on, worst = march.corrected(m, (inverse, hands_on), x, slow, arriving, values, worst)
        else:
            on = FlatArriving(arriving.position + march.last_increment(x), values[1])
        return (on, sensitivities, x, worst), (x, inverse, hands_on, response, by_position, hands_on_by_position)

    start = march.start()
    none = FlatArriving(*(jnp.zeros((a.size, march.num_seen)) for a in start))
    carry = start, none, last, Worst.none()
    (end, sensitivities, _, worst), stacked = jax.lax.scan(interval, carry, (jnp.arange(march.n), x))
    x, inverse, hands_on, response, *by_positions = stacked
    slow_inverse, slow_values = march.slow_inverse(z, end, sensitivities)
    matrices = Matrices(inverse, hands_on, response, slow_inverse)
    return matrices, march.passed(matrices, z, x, worst, end, slow_values), by_positions


def kept_pass(march: MarchEquations, matrices: Matrices, z, x, last, from_last) -> Passed:
    """A pass with matrices of earlier unknowns: every interval starts from the corrected end of the interval before.

    Arguments as of `linearised_pass`.
    """
    slow = march.seen(z)

    def interval(carry, unknowns_and_matrices):
        arriving, last, worst = carry
        m, x, *of_interval = unknowns_and_matrices
        x = jnp.where(from_last, last, x)
        values = march.interval(m, x, arriving, slow)
        x, on, worst = march.corrected(m, of_interval, x, slow, arriving, values, worst)
        return (on, x, worst), x

    intervals = jnp.arange(march.n), x, matrices.inverse, matrices.hands_on
    (end, _, worst), x = jax.lax.scan(interval, (march.start(), last, Worst.none()), intervals)
    return march.passed(matrices, z, x, worst, end, march.slow_equations(z, end))

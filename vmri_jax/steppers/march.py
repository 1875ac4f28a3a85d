"""The march: a macro step of any Lagrangian, micro interval by micro interval, with exact matrices.

A micro interval is a map ``(q_f, p_f, slow path) -> (q_f, p_f, impulses on the slow path)``, given by its equations R_m = 0 for its own
unknowns x_m (`vmri_jax.schemes.intervals`). Unknowns of the macro step are those and z, the slow increments and slow multipliers.

A pass goes over the intervals in order. Each corrects its unknowns once, and hands on what follows from the correction to first
order:

    d_m = -(dR_m/dx_m)^-1 R_m        x_m <- x_m + d_m

After the last one the slow equations R_s = 0, which the impulses of all intervals enter, are corrected once,

    d = -(dR_s/dz)^-1 R_s            z <- z + d,    x_m <- x_m + (dx_m/dz) d

In an *exact* pass the matrices are computed: those of the intervals by `jax.jacfwd`, and dR_s/dz with the answer of all
intervals to the slow path, since the pass carries along how x_m and what is handed on change with z. Further passes, also those of
the next steps, keep all matrices while the corrections shrink, and cost one gradient of the action each.

Nothing here remembers a step before: the guess and the matrices that are kept come from `vmri_jax.steppers.marched`.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vmri_jax.kernels import inverse_in_loop, matmul, matvec, max_abs, saddle
from vmri_jax.schemes.equations import StepEquations, Unknowns
from vmri_jax.schemes.intervals import Arriving, Intervals, IntervalUnknowns


class IntervalMatrices(NamedTuple):
    """The equations of a micro interval, linearised: k unknowns, r n_v slow increments that are seen; o numbers are handed on besides q_f.

    inverse: of the derivative of its residual by its unknowns.
    by_position, by_slow: derivative of the residual by the position that arrives and by the slow increments.
    hands_on, hands_on_by_position, hands_on_by_slow: derivative of the momentum and the impulses that are handed on.
    """

    inverse: Float[Array, "k k"]
    by_position: Float[Array, "k n_f"]
    by_slow: Float[Array, "k r*n_v"]
    hands_on: Float[Array, "o k"]
    hands_on_by_position: Float[Array, "o n_f"]
    hands_on_by_slow: Float[Array, "o r*n_v"]


class Matrices(NamedTuple):
    """What an exact pass leaves for further passes.

    inverse, hands_on: of the intervals, as of `IntervalMatrices`, with the intervals as first axis.
    response: ``dx_m/dz`` by the slow increments that intervals see.
    slow: inverse of the slow equations once the intervals are eliminated.
    """

    inverse: Float[Array, "num_micro k k"]
    hands_on: Float[Array, "num_micro o k"]
    response: Float[Array, "num_micro k r*n_v"]
    slow: Float[Array, "b b"]


class Handed(NamedTuple):
    """What arrives at an interval, as vectors or as matrices with one column for each direction.

    position: q_f.
    rest: momentum p_f times h, then the gradients of h times the action by the start and by the increments of the slow path.
    """

    position: Float[Array, "n_f ..."]
    rest: Float[Array, "o ..."]


class MarchEquations:
    """The equations of a macro step with unknowns in rows: x (num_micro, k) of the intervals, z (b,) of the slow path.

    Args:
        equations: of the macro step.
        inverted: inverts a matrix ``[[A, B], [C, 0]]``, given as (A, B, C, number of nodes).
    """

    def __init__(self, equations: StepEquations, inverted=None):
        self.equations, self.intervals = equations, Intervals(equations)
        self.inverted = inverted or inverse_with_multipliers
        self.n, self.r = equations.scheme.num_micro, equations.scheme.degree
        self.n_s, self.n_f = equations.q_s.size, equations.q_f.size
        self.n_g, self.n_gs = equations.system.num_constraints(equations.q_s, equations.q_f)
        self.n_v = self.intervals.seen.count  # the slow variables that intervals see
        self.num_fast, self.num_slow, self.num_seen = self.r * self.n_f, self.r * self.n_s, self.r * self.n_v

    def rows(self, x: Unknowns):
        """(z, x) of the unknowns by name."""
        z = jnp.concatenate([x.slow.reshape(-1), x.slow_multiplier.reshape(-1)])
        return z, jnp.concatenate([x.fast.reshape(self.n, -1), x.multiplier.reshape(self.n, -1)], axis=1)

    def by_name(self, z, x) -> Unknowns:
        """The unknowns by name, of their rows."""
        return Unknowns(
            z[: self.num_slow].reshape(self.r, self.n_s),
            z[self.num_slow :].reshape(self.r, self.n_gs),
            x[:, : self.num_fast].reshape(self.n, self.r, self.n_f),
            x[:, self.num_fast :].reshape(self.n, self.r, self.n_g),
        )

    def seen(self, z):
        """(r n_v,) the slow increments in z that intervals see."""
        return self.intervals.seen.take(z[: self.num_slow].reshape(self.r, self.n_s)).reshape(self.num_seen)

    def start(self) -> Handed:
        """What arrives at the first interval."""
        equations = self.equations
        return Handed(
            equations.q_f, jnp.concatenate([equations.micro_dt * equations.p_f, jnp.zeros(self.n_v + self.num_seen)])
        )

    def no_matrices(self) -> Matrices:
        """The shapes of the matrices, all zero."""
        n, k, o = self.n, self.num_fast + self.r * self.n_g, self.n_f + self.n_v + self.num_seen
        b = self.num_slow + self.r * self.n_gs
        return Matrices(*map(jnp.zeros, ((n, k, k), (n, o, k), (n, k, self.num_seen), (b, b))))

    def interval(self, m, x, arriving: Handed, slow):
        """Residual (k,) of interval m, and the rest (o,) that it hands on."""
        unknowns = IntervalUnknowns(
            x[: self.num_fast].reshape(self.r, self.n_f), x[self.num_fast :].reshape(self.r, self.n_g)
        )
        residual, on = self.intervals.evaluate(m, unknowns, self._apart(arriving), slow.reshape(self.r, self.n_v))
        return jnp.concatenate([residual.fast.reshape(-1), residual.multiplier.reshape(-1)]), _together(on).rest

    def slow_equations(self, z, arriving: Handed):
        """Residual (b,) of the slow equations, and the slow momentum at the end."""
        slow, multiplier = z[: self.num_slow].reshape(self.r, self.n_s), z[self.num_slow :].reshape(self.r, self.n_gs)
        (rows, g), p_s = self.intervals.slow_evaluate(slow, multiplier, self._apart(arriving))
        return jnp.concatenate([rows.reshape(-1), g.reshape(-1)]), p_s

    def _apart(self, arriving: Handed) -> Arriving:
        p_f, start, slow = jnp.split(arriving.rest, [self.n_f, self.n_f + self.n_v])
        return Arriving(arriving.position, p_f, start, slow.reshape(self.r, self.n_v))

    def interval_matrices(self, m, x, arriving: Handed, slow) -> IntervalMatrices:
        """The derivatives of interval m."""

        def all_of(x, position, slow):
            return self.interval(m, x, Handed(position, arriving.rest), slow)

        by_x, by_position, by_slow = zip(
            *jax.jacfwd(all_of, argnums=(0, 1, 2))(x, arriving.position, slow), strict=True
        )
        return IntervalMatrices(
            self.inverse(by_x[0], self.num_fast), by_position[0], by_slow[0], by_x[1], by_position[1], by_slow[1]
        )

    def slow_inverse(self, z, arriving: Handed, answers: Handed):
        """Inverse (b, b) of the slow equations.

        Args:
            answers: how what arrives at them changes with the slow increments, one column for each that intervals see.
        """

        def slow_residual_change(dz, answer: Handed):
            return jax.jvp(lambda z, a: self.slow_equations(z, a)[0], (z, arriving), (dz, answer))[1]

        # other slow increments and multipliers of the slow constraints change nothing that arrives
        def for_all(answer):
            none = jnp.zeros((len(answer), self.r, self.n_s))
            seen = self.intervals.seen.put(answer.reshape(len(answer), self.r, self.n_v), none)
            return jnp.pad(seen.reshape(len(answer), self.num_slow), [(0, 0), (0, z.size - self.num_slow)])

        answers = jax.tree.map(for_all, answers)
        matrix = jax.vmap(slow_residual_change, in_axes=-1, out_axes=-1)(jnp.eye(z.size), answers)
        return self.inverse(matrix, self.num_slow)

    def inverse(self, matrix, size: int):
        """Of a matrix whose first `size` unknowns are increments, the others multipliers."""
        return self.inverted(matrix[:size, :size], matrix[:size, size:], matrix[size:, :size], self.r)

    def answer(self, matrices: IntervalMatrices, residual, arriving: Handed, slow=None):
        """To a change of the residual, of what arrives, and (unless None) of the slow increments: (dx, change of what is handed on).

        All have one column for each direction. With dx the linearised residual is zero.
        """
        rows = residual + matmul(matrices.by_position, arriving.position)
        rest = matmul(matrices.hands_on_by_position, arriving.position)
        if slow is not None:
            rows, rest = rows + matmul(matrices.by_slow, slow), rest + matmul(matrices.hands_on_by_slow, slow)
        rows = rows.at[: self.n_f].add(arriving.rest[: self.n_f])  # the momentum that arrives
        dx = -matmul(matrices.inverse, rows)
        return dx, self.handed(arriving, dx, matmul(matrices.hands_on, dx) + rest)

    def last_increment(self, x):
        """(n_f, ...) of the unknowns (k, ...): from the start of the interval to its end."""
        return x[self.num_fast - self.n_f : self.num_fast]

    def handed(self, arriving: Handed, dx, rest):
        """The change of what is handed on: the momentum is a new one, impulses add up."""
        position = arriving.position + self.last_increment(dx)
        return Handed(position, rest.at[self.n_f :].add(arriving.rest[self.n_f :]))

    def corrected(self, inverse, hands_on, x, residual, arriving: Handed, rest) -> tuple[Any, Handed]:
        """The correction ``-(dR/dx)^-1 R`` of an interval, and what it hands on with it."""
        d = -matvec(inverse, residual)
        return d, Handed(arriving.position + self.last_increment(x + d), rest + matvec(hands_on, d))

    def passed(self, matrices: Matrices, z, x, worst: "Worst", end: Handed) -> "Passed":
        """A pass that has met all intervals, with the correction of the slow unknowns."""
        residual, p_s = self.slow_equations(z, end)
        dz = -matvec(matrices.slow, residual)
        dx = jnp.sum(matrices.response * self.seen(dz), axis=-1)
        return Passed(z, x, dz, dx, end, p_s, worst.add(residual, dz, worst.moved))


def _together(on: Arriving) -> Handed:
    return Handed(on.q_f, jnp.concatenate([on.p_f, on.start, on.slow.reshape(-1)]))


def inverse_with_multipliers(a, b, c, nodes: int):
    """Inverse of ``[[A, B], [C, 0]]`` by elimination, kept regular where constraints become dependent."""
    return inverse_in_loop(saddle(a, b, c) if b.shape[-1] else a)


class Worst(NamedTuple):
    """The worst of all intervals in a pass.

    moved: largest correction of a fast increment.
    rows: largest entry of a residual before the corrections; momentum equations are times h.
    is_singular: whether a finite residual had a correction that is not finite.
    """

    moved: Float[Array, ""]
    rows: Float[Array, ""]
    is_singular: Bool[Array, ""]

    @classmethod
    def none(cls) -> "Worst":
        """Before the first interval."""
        return cls(jnp.zeros(()), jnp.zeros(()), jnp.asarray(False))

    def add(self, residual, correction, moved) -> "Worst":
        """With one more residual, its correction, and the largest correction of a fast increment in it."""
        rows = max_abs(residual)
        singular = jnp.isfinite(rows) & ~jnp.isfinite(max_abs(correction))
        return Worst(jnp.maximum(self.moved, moved), jnp.maximum(self.rows, rows), self.is_singular | singular)


class Passed(NamedTuple):
    """Unknowns after a pass, with their next correction by the slow equations.

    z, x: unknowns, x corrected by the pass.
    dz, dx: correction of z, and the answer of x to it; the next pass begins with it.
    end, p_s: what the last interval hands on, and the slow momentum at the end.
    """

    z: Float[Array, "b"]
    x: Float[Array, "num_micro k"]
    dz: Float[Array, "b"]
    dx: Float[Array, "num_micro k"]
    end: Handed
    p_s: Float[Array, "n_s"]
    worst: Worst


def exact_pass(march: MarchEquations, z, x, last, from_last) -> tuple[Matrices, Passed]:
    """A pass that computes all matrices, each interval at what the intervals before it hand on after their correction.

    Args:
        march: the equations.
        z, x: unknowns.
        last: (k,) unknowns of the last interval of the step before.
        from_last: whether each interval starts from the unknowns of the interval before, instead of those in x.
    """
    slow, unit = march.seen(z), jnp.eye(march.num_seen)

    def interval(carry, given):
        arriving, answers, last, worst = carry
        m, x = given
        x = jnp.where(from_last, last, x)
        (residual, rest), push = jax.linearize(partial(march.interval, m), x, arriving, slow)

        # columns: the unknowns of the interval, then the slow increments with the answers of the intervals before. One program for both:
        # the tangents of the action are most of what there is to compile
        by_unknowns = jnp.eye(x.size, x.size + march.num_seen)
        by_slow = jax.tree.map(lambda a: jnp.pad(a, ((0, 0), (x.size, 0))), (answers, unit))
        by_both, on_by_both = jax.vmap(push, in_axes=-1, out_axes=-1)(by_unknowns, *by_slow)
        (by_x, rows), (hands_on, rests) = (jnp.split(a, [x.size], axis=1) for a in (by_both, on_by_both))
        inverse = march.inverse(by_x, march.num_fast)
        response = -matmul(inverse, rows)
        answers = Handed(answers.position + march.last_increment(response), rests + matmul(hands_on, response))

        d, on = march.corrected(inverse, hands_on, x, residual, arriving, rest)
        carry = on, answers, x + d, worst.add(residual, d, max_abs(d[: march.num_fast]))
        return carry, (x + d, inverse, hands_on, response)

    start = march.start()
    none = Handed(*(jnp.zeros((a.size, march.num_seen)) for a in start))
    carry = start, none, last, Worst.none()
    (end, answers, _, worst), kept = jax.lax.scan(interval, carry, (jnp.arange(march.n), x))
    x, inverse, hands_on, response = kept
    matrices = Matrices(inverse, hands_on, response, march.slow_inverse(z, end, answers))
    return matrices, march.passed(matrices, z, x, worst, end)


def further_pass(march: MarchEquations, matrices: Matrices, z, x, last, from_last) -> Passed:
    """A pass with the matrices of an earlier one, of this step or of one before. Arguments as of `exact_pass`."""
    slow = march.seen(z)

    def interval(carry, given):
        arriving, last, worst = carry
        m, x, inverse, hands_on = given
        x = jnp.where(from_last, last, x)
        residual, rest = march.interval(m, x, arriving, slow)
        d, on = march.corrected(inverse, hands_on, x, residual, arriving, rest)
        return (on, x + d, worst.add(residual, d, max_abs(d[: march.num_fast]))), x + d

    given = jnp.arange(march.n), x, matrices.inverse, matrices.hands_on
    (end, _, worst), x = jax.lax.scan(interval, (march.start(), last, Worst.none()), given)
    return march.passed(matrices, z, x, worst, end)


class Factors(NamedTuple):
    """The Newton matrix of a macro step, with the intervals eliminated, one after the other.

    intervals: their derivatives, with the intervals as first axis.
    response, slow: as of `Matrices`.
    """

    intervals: IntervalMatrices
    response: Float[Array, "num_micro k r*n_v"]
    slow: Float[Array, "b b"]


def factor(march: MarchEquations, z, x) -> Factors:
    """The matrix ``dR/d(z, x)`` at the solution, factored. A macro step is solved with it once, for the derivative of the solution."""
    slow, unit = march.seen(z), jnp.eye(march.num_seen)

    def interval(carry, given):
        arriving, answers = carry
        m, x = given
        rest = march.interval(m, x, arriving, slow)[1]
        matrices = march.interval_matrices(m, x, arriving, slow)
        response, answers = march.answer(matrices, jnp.zeros((x.size, march.num_seen)), answers, unit)
        return (Handed(arriving.position + march.last_increment(x), rest), answers), (matrices, response)

    start = march.start()
    none = Handed(*(jnp.zeros((a.size, march.num_seen)) for a in start))
    (end, answers), (matrices, response) = jax.lax.scan(interval, (start, none), (jnp.arange(march.n), x))
    return Factors(matrices, response, march.slow_inverse(z, end, answers))


def solve(march: MarchEquations, factors: Factors, rows_z, rows_x):
    """(dz, dx) with ``dR/d(z, x) (dz, dx) = -(rows_z, rows_x)``; linear in the rows, and has a transpose."""

    def interval(arriving, given):
        matrices, rows = given
        dx, arriving = march.answer(matrices, rows[:, None], arriving)
        return arriving, dx[:, 0]

    none = Handed(*(jnp.zeros((a.size, 1)) for a in march.start()))
    end, dx = jax.lax.scan(interval, none, (factors.intervals, rows_x))
    # the slow equations are linear in what arrives at them
    along = Handed(*(a[:, 0] for a in end))
    zero = jnp.zeros_like(rows_z)
    change = jax.jvp(lambda a: march.slow_equations(zero, a)[0], (march.start(),), (along,))[1]
    dz = -matvec(factors.slow, rows_z + change)
    return dz, dx + jnp.sum(factors.response * march.seen(dz), axis=-1)

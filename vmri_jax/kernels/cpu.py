"""Small dense algebra as elementwise operations, and settings of the steppers: the names of `plain`, tuned for small
systems on CPUs.

XLA compiles a loop without library calls into one kernel; a LAPACK call or a matrix product inside the loop costs about
a microsecond each. Elementwise operations therefore eliminate systems of up to `ELEMENTWISE` rows, and invert matrices
of up to `INVERTED`, LAPACK larger ones.
"""

import jax
import jax.numpy as jnp

UNROLLED = 8
"""Most rows of a system whose elimination is unrolled. A larger number makes steps of small systems faster and
compiling slower: larger systems are eliminated in a loop."""
UNROLLED_TURNS = 3
"""Turns of that loop that XLA unrolls. A larger number makes compiling slower."""
REGISTER = 4
"""Float64 numbers in a vector register (AVX2); rows of matrices are padded to a multiple of it."""
ELEMENTWISE = 16
"""Most rows of a system that elementwise operations eliminate. Beyond, LAPACK is faster in spite of its call."""
INVERTED = 160
"""Most rows of a matrix that elementwise operations invert. They take 0.3 of LAPACK's time for 20 rows, 0.8 for 60,
1.3 for 120 and 1.7 for 170; but inverses are kept for many steps, whose loop is one kernel without LAPACK: with it a
step of a four-bar by directors (117 rows) takes 1.35 times as long."""

# Memory of the steppers from step to step, and special cases that they know. Results agree without them, up to the
# tolerance.

SLOW_ORDER = 10
"""Highest order of the polynomial through the unknowns of the last steps that predicts the next step. With a lower
order small steps take more passes; a higher order is never the best."""
CONTRACTION = 0.03
"""Largest ratio of the corrections of two passes with which exact matrices are kept. An exact pass costs about as much
as four passes with kept matrices for constant masses, more in joint coordinates. A smaller ratio makes more passes
exact. A larger ratio makes passes cheaper but raises their number: 0.1 takes a quarter more passes, in 0.8 of the time
for the satellite of the gallery, in 0.9 to 1.0 of it for a double pendulum in angles."""
FEWEST_IN_PARTS = 4
"""Fewest variables with masses that vary for which LAPACK inverts the matrices of the masses. XLA compiles a loop of
steps with such a call in parts, without one as one kernel, in which a step of two angles takes a third of the time.
With a larger number an engine waits 1.7 times as long for its first result, and takes 0.8 of the time for a step."""
LARGEST_RENEWED = 16
"""Most rows of the matrix K of a micro interval that every macro step computes anew; a larger K is kept until a step
takes more than `EXTRA_PASSES` passes above the fewest with it (`vmri_jax.steppers.nested`). With a larger number, macro
steps of large systems spend most of their time on K."""
DIAGONAL_MATRICES = True
"""Whether K is one matrix per coordinate where W is a sum over the coordinates."""
LINEARISES_FORCES = True
"""Whether updates of the slow unknowns use the derivative of the slow forces where an update by the masses alone would
cost a pass."""
COLLOCATES = True
"""Whether `Collocation` solves a single interval of high degree, for all variables at once."""
DRIFTS = True
"""Whether `Rattle` solves a drift along constraints, for its multipliers alone."""
LANES_IN_TURN = True
"""Whether lanes of a batch with larger equations are computed one after the other on a CPU."""


def matmul(a, b):
    """``a @ b`` of (..., i, k) and (..., k, j), as a sum of products."""
    if a.shape[-2] * a.shape[-1] * b.shape[-1] > ELEMENTWISE**3:
        return a @ b
    return jnp.sum(a[..., :, :, None] * b[..., None, :, :], axis=-2)


def matvec(a, x):
    """``a @ x`` of (..., i, k) and (..., k), as a sum of products up to `ELEMENTWISE` rows."""
    if a.shape[-2] * a.shape[-1] > ELEMENTWISE**2:
        return jnp.matvec(a, x)
    return jnp.sum(a * x[..., None, :], axis=-1)


def solve(a, b):
    """The x with ``a x = b`` for a (n, n), b (n, m): Gauss-Jordan without pivoting, or LU with it beyond `ELEMENTWISE`
    rows.

    Without pivoting the leading blocks of a must be regular: those of mass matrices, of ``G M^-1 G^T``, of saddles in
    the order (unknowns, multipliers), of the derivatives k_ij of a path, and of matrices that differ little from these.
    """
    n = a.shape[0]
    if n > ELEMENTWISE:
        return jnp.linalg.solve(a, b)

    rows = jnp.concatenate([a, b], axis=1)
    if n > UNROLLED:
        return jax.lax.fori_loop(0, n, _eliminated, rows, unroll=UNROLLED_TURNS)[:, n:]
    # pivot row r_1 <- r_1 / a_11, others r_i <- r_i - a_i1 r_1; the used column is dropped, and after n turns b has
    # become x
    for _ in range(n):
        row = rows[0, 1:] / rows[0, 0]
        rows = jnp.concatenate([rows[1:, 1:] - rows[1:, :1] * row, row[None]])  # the first row becomes the last
    return rows


def _eliminated(k, rows):
    """Turn k of `solve` in place: row k becomes r_k / a_kk, row i becomes r_i - a_ik r_k / a_kk."""
    row = rows[k] / rows[k, k]
    return jnp.where(jnp.arange(rows.shape[0])[:, None] == k, row, rows - rows[:, k, None] * row)


def inverse(a):
    """The inverses of a (..., n, n), real or complex; without pivoting (see `solve`) up to `INVERTED` rows: every turn
    replaces one column by a column of the inverse."""
    n = a.shape[-1]
    if n > INVERTED:
        return jnp.linalg.inv(a)
    if n > UNROLLED:
        full = jnp.pad(a, [(0, 0)] * (a.ndim - 1) + [(0, -n % REGISTER)])
        return jax.lax.fori_loop(0, n, _exchanged, full, unroll=UNROLLED_TURNS)[..., :n]
    for _ in range(n):
        a = _first_exchanged(a)
    return a


def _exchanged(k, a):
    """Turn k of `inverse` in place: an exchange step with the pivot a_kk. For all i, j other than k,

    a_ij <- a_ij - a_ik a_kj / a_kk        a_kj <- a_kj / a_kk        a_ik <- -a_ik / a_kk        a_kk <- 1 / a_kk
    """
    rows, columns = (jnp.arange(m) == k for m in a.shape[-2:])
    row = jnp.where(columns, 1.0, a[..., k, None, :]) / a[..., k, k, None, None]
    return jnp.where(rows[:, None], row, jnp.where(columns, 0.0, a) - a[..., :, k, None] * row)


def _first_exchanged(a):
    """The exchange step of `_exchanged` with the first pivot.

    All rows and columns then move up by one; the first row and column become the last.
    """
    pivot, unit = 1 / a[..., :1, :1], jnp.ones((*a.shape[:-2], 1, 1))
    row = jnp.concatenate([a[..., :1, 1:] * pivot, pivot], axis=-1)
    column = jnp.concatenate([a[..., 1:, :1], -unit], axis=-2)
    moved = jax.lax.pad(a, jnp.zeros((), a.dtype), [(0, 0, 0)] * (a.ndim - 2) + [(-1, 1, 0)] * 2)
    return moved - column * row


def max_abs(a):
    """The largest absolute value in a; 0 if a is empty, not finite if an entry is not.

    The bits of ``|a|``, read as integers, have the same order. XLA may take a maximum of integers in any order, and
    uses vector registers; a maximum of floats it takes number by number, and may lose a NaN. The maximum goes axis by
    axis, so that rows fill the registers.
    """
    order = jax.lax.bitcast_convert_type(jnp.abs(a), jnp.int64)
    while order.ndim:
        order = jnp.max(order, axis=0, initial=0)
    return jax.lax.bitcast_convert_type(order, jnp.float64)

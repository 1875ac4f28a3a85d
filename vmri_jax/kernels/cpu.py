"""Small dense algebra as elementwise operations, and what steppers remember: the names of `plain`, tuned for small systems on CPUs.

XLA compiles a loop without library calls into one kernel; a LAPACK call or a matrix product inside it costs about a
microsecond each. Up to `ELEMENTWISE` rows systems are therefore eliminated by elementwise operations, beyond by LAPACK.
"""

import jax
import jax.numpy as jnp

UNROLLED = 8
"""Largest system whose elimination is written out step by step; larger ones go through a loop, which compiles faster."""
TOGETHER = 3
"""Steps of that loop that are written out."""
REGISTER = 4
"""Numbers in a vector register; rows of matrices are padded to a multiple of it."""
ELEMENTWISE = 16
"""Largest system that is eliminated by elementwise operations."""

# What steppers remember from step to step, and which special cases they know. The results are the same without.

SLOW_ORDER = 10
"""Highest order of the polynomial through the slow unknowns of the last steps, from which the next step starts. With less, small steps take
more passes; a higher one is never the best."""
CONTRACTION = 0.03
"""Largest ratio of the corrections of two passes with which exact matrices are kept. An exact pass costs about as much as four others with
constant masses, more in joint coordinates. With a larger ratio steps take more passes: at 0.1 the satellite of the gallery takes 0.8 of the time,
a double pendulum in angles 0.9 to 1.0, but passes rise by a quarter. With a smaller one more passes are exact."""
LARGEST_RENEWED = 16
"""Rows of the matrix K of a micro interval up to which it is computed in every macro step; a larger one is kept while the number of passes
does not rise. With more, macro steps of large systems spend their time on it."""
DIAGONAL_MATRICES = True
"""Whether K is taken for every coordinate alone where W is a sum over the coordinates."""
LINEARISES_FORCES = True
"""Whether an update of the slow unknowns is solved for with the derivative of the slow forces where the masses alone would cost a pass."""
COLLOCATES = True
"""Whether one interval of high degree is solved for all variables at once, in modes of time."""
DRIFTS = True
"""Whether a drift along constraints is solved for its multipliers alone (RATTLE)."""
DEFERS_PROJECTION = True
"""Whether momenta are projected onto the hidden constraints only where they are looked at, after drifts."""


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
    """The x with ``a x = b`` for a (n, n), b (n, m): Gauss-Jordan without pivoting, or LU with it beyond `ELEMENTWISE` rows.

    Without pivoting a must be (close to) symmetric definite: mass matrices, ``G M^-1 G^T`` and their perturbations.
    """
    n = a.shape[0]
    if n > ELEMENTWISE:
        return jnp.linalg.solve(a, b)

    rows = jnp.concatenate([a, b], axis=1)
    if n > UNROLLED:
        return jax.lax.fori_loop(0, n, _eliminated, rows, unroll=TOGETHER)[:, n:]
    for _ in range(n):
        row = rows[0, 1:] / rows[0, 0]
        rows = jnp.concatenate([rows[1:, 1:] - rows[1:, :1] * row, row[None]])  # the first row becomes the last
    return rows


def _eliminated(k, rows):
    """One step of `solve`, in place."""
    unit = jnp.arange(rows.shape[0])[:, None] == k
    return rows - (rows[:, k, None] - unit) * (rows[k] / rows[k, k])


def inverse(a):
    """The inverses of a (..., n, n), real or complex, see `solve`: every pivot's column is replaced by one of the inverse."""
    n = a.shape[-1]
    if n > ELEMENTWISE:
        return jnp.linalg.inv(a)
    return inverse_in_loop(a)


def inverse_in_loop(a):
    """`inverse` of every size without LAPACK.

    With `jnp.linalg.inv` of 18 rows in the loop of a march, over lanes and tangents (`advise` for docs/how_to/molecules.md), XLA's CPU
    runtime waits for ever (jaxlib 0.10.2).
    """
    n = a.shape[-1]
    if n > UNROLLED:
        full = jnp.pad(a, [(0, 0)] * (a.ndim - 1) + [(0, -n % REGISTER)])
        return jax.lax.fori_loop(0, n, _exchanged, full, unroll=TOGETHER)[..., :n]
    for _ in range(n):
        a = _first_exchanged(a)
    return a


def _exchanged(k, a):
    """One step of `inverse`, in place."""
    rows, columns = (jnp.arange(m) == k for m in a.shape[-2:])
    row = jnp.where(columns, 1.0, a[..., k, None, :]) / a[..., k, k, None, None]
    return jnp.where(columns, rows[:, None] * 1.0, a) - (a[..., :, k, None] - rows[:, None]) * row


def _first_exchanged(a):
    """One step of `inverse` with the first pivot. All rows and columns move up by one, and the first ones become the last."""
    pivot, one = 1 / a[..., :1, :1], jnp.ones((*a.shape[:-2], 1, 1))
    row = jnp.concatenate([a[..., :1, 1:] * pivot, pivot], axis=-1)
    column = jnp.concatenate([a[..., 1:, :1], -one], axis=-2)
    moved = jax.lax.pad(a, jnp.zeros((), a.dtype), [(0, 0, 0)] * (a.ndim - 2) + [(-1, 1, 0)] * 2)
    return moved - column * row


def max_abs(a):
    """The largest absolute value in a, 0 of nothing, not finite if an entry is not.

    As integers with the order of ``|a|``, those of the same bits: a maximum of integers may be taken in any order, so that it
    fills vector registers; one of floats is taken number by number, and XLA loses NaN in some of them. Axis by axis, so
    that rows fill the registers.
    """
    order = jax.lax.bitcast_convert_type(jnp.abs(a), jnp.int64)
    while order.ndim:
        order = jnp.max(order, axis=0, initial=0)
    return jax.lax.bitcast_convert_type(order, jnp.float64)

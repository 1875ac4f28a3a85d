"""Small dense algebra as elementwise operations.

XLA compiles a loop without library calls into one kernel; a LAPACK call or a matrix product inside it costs about a
microsecond each. Up to `ELEMENTWISE` rows systems are therefore eliminated by elementwise operations, beyond by LAPACK.
"""

import jax
import jax.numpy as jnp
import numpy as np

UNROLLED = 4
"""Largest system whose elimination is written out step by step; larger ones go through a loop."""
ELEMENTWISE = 16
"""Largest system that is eliminated by elementwise operations."""

REGULARIZATION = 2e-15
"""Part of its diagonal that is added to ``G M^-1 G^T``, see `regularized`."""


def regularized(a):
    """``G M^-1 G^T`` (n, n), kept invertible where rows of G become dependent.

    Multipliers are then nearly those of least norm. Residuals are exact, so that it decides on convergence alone, not
    on solutions: errors shrink by REGULARIZATION times the condition number, instead of at once.
    """
    return a * (1 + REGULARIZATION * np.eye(a.shape[0]))


def saddle(a, b, c):
    """``[[a, b], [c, 0]]`` over any leading axes, `regularized`: 0 becomes a small part of the diagonal of ``-c a^-1 b``."""
    diagonal = jnp.diagonal(a, axis1=-2, axis2=-1)[..., None]
    scale = jnp.sum(jnp.swapaxes(c, -1, -2) * b / jnp.where(diagonal == 0, 1.0, diagonal), axis=-2)
    corner = -REGULARIZATION * scale[..., None] * np.eye(b.shape[-1])
    return jnp.concatenate([jnp.concatenate([a, b], axis=-1), jnp.concatenate([c, corner], axis=-1)], axis=-2)


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

    def eliminate(k, rows):
        row = rows[k] / rows[k, k]
        return rows - (rows[:, k] - (jnp.arange(n) == k))[:, None] * row

    rows = jnp.concatenate([a, b], axis=1)
    if n > UNROLLED:
        return jax.lax.fori_loop(0, n, eliminate, rows)[:, n:]
    for k in range(n):
        rows = eliminate(k, rows)
    return rows[:, n:]


def inverse(a):
    """The inverse of a (n, n), see `solve`."""
    return solve(a, jnp.eye(a.shape[0]))

"""Small dense algebra as a reader expects it, NumPy's names and LAPACK, and steppers that remember nothing. What `cpu` is held against."""

import jax.numpy as jnp

SLOW_ORDER = 0
"""Slow unknowns start from their last values."""
CONTRACTION = -1.0
"""Matrices are never kept: the ratio of two corrections is not below zero."""
LARGEST_RENEWED = 10**9
"""All are renewed."""
DIAGONAL_MATRICES = LINEARISES_FORCES = COLLOCATES = DRIFTS = DEFERS_PROJECTION = False
"""No special cases."""


def matmul(a, b):
    """``a @ b`` of (..., i, k) and (..., k, j)."""
    return a @ b


def matvec(a, x):
    """``a @ x`` of (..., i, k) and (..., k)."""
    return jnp.matvec(a, x)


def solve(a, b):
    """The x with ``a x = b`` for a (n, n), b (n, m)."""
    return jnp.linalg.solve(a, b)


def inverse(a):
    """The inverses of a (..., n, n), real or complex."""
    return jnp.linalg.inv(a)


def max_abs(a):
    """The largest absolute value in a, 0 of nothing, not finite if an entry is not."""
    largest = jnp.max(jnp.abs(a), initial=0.0)
    return jnp.where(jnp.all(jnp.isfinite(a)), largest, jnp.inf)

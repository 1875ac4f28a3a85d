"""Small dense algebra by LAPACK, and steppers without special cases and without predictors: the reference for tests of
`cpu`."""

import jax.numpy as jnp

SLOW_ORDER = 0
"""Order 0: unknowns start from their last values."""
CONTRACTION = -1.0
"""Largest ratio of two corrections with which matrices are kept: negative, so that all passes are exact."""
LARGEST_RENEWED = 10**9
"""Rows of K up to which every macro step computes it: all sizes."""
FEWEST_IN_PARTS = 10**9
"""No system has so many variables: all take `inverse`."""
DIAGONAL_MATRICES = LINEARISES_FORCES = COLLOCATES = DRIFTS = LANES_IN_TURN = False
"""Steppers and batches do not use any special case."""


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
    """The largest absolute value in a; 0 if a is empty, not finite if an entry is not."""
    largest = jnp.max(jnp.abs(a), initial=0.0)
    return jnp.where(jnp.all(jnp.isfinite(a)), largest, jnp.inf)

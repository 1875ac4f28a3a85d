"""Matrices of constrained equations, kept invertible where constraints become dependent."""

import jax.numpy as jnp
import numpy as np

REGULARIZATION = 2e-15
"""Part of its diagonal that is added to ``G M^-1 G^T``, see `regularized`."""


def regularized(a):
    """``G M^-1 G^T`` (..., n, n), kept invertible where rows of G become dependent.

    Multipliers are then nearly those of least norm. Residuals are exact, so that it decides on convergence alone, not
    on solutions: errors shrink by REGULARIZATION times the condition number, instead of at once.
    """
    return a * (1 + REGULARIZATION * np.eye(a.shape[-1]))


def saddle(a, b, c):
    """``[[a, b], [c, 0]]`` over any leading axes, `regularized`: 0 becomes a small part of the diagonal of ``-c a^-1 b``."""
    diagonal = jnp.diagonal(a, axis1=-2, axis2=-1)[..., None]
    scale = jnp.sum(jnp.swapaxes(c, -1, -2) * b / jnp.where(diagonal == 0, 1.0, diagonal), axis=-2)
    corner = -REGULARIZATION * scale[..., None] * np.eye(b.shape[-1])
    return jnp.concatenate([jnp.concatenate([a, b], axis=-1), jnp.concatenate([c, corner], axis=-1)], axis=-2)

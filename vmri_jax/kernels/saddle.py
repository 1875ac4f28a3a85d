"""Regularised matrices of constrained equations, which stay invertible where constraints become dependent."""

import jax.numpy as jnp
import numpy as np

REGULARIZATION = 2e-15
"""Relative change of the diagonal of ``G M^-1 G^T``, a few units of round-off, see `regularized`. A larger value slows
down convergence with nearly dependent constraints; a smaller one is lost in round-off."""


def regularized(a):
    """The matrix ``G M^-1 G^T`` (..., n, n) with its diagonal times 1 + REGULARIZATION: invertible also for dependent
    rows of G.

    For dependent rows the multipliers are then nearly those of least norm. The residuals of the iterations are exact,
    so that the regularisation changes their convergence and not the solution: every iteration multiplies the error by
    REGULARIZATION times the condition number.
    """
    return a * (1 + REGULARIZATION * np.eye(a.shape[-1]))


def least_norm(a, rows):
    """``a^+ rows`` for a = ``G M^-1 G^T`` (n, n) with a diagonal of ones, in which the units of rows cancel: of
    dependent rows the least multipliers. The derivatives of a^+ are finite where rows do not couple;
    `lstsq` has none there."""
    xp = np if isinstance(a, np.ndarray) else jnp
    diagonal = xp.diagonal(a)
    root = xp.sqrt(xp.where(diagonal > 0, diagonal, 1.0))
    return xp.linalg.pinv(a / root[:, None] / root, np.finfo(float).eps * len(a)) @ (rows / root) / root


def saddle(a, b, c):
    """``[[a, b], [c, e]]`` over any leading axes, with ``e = -REGULARIZATION diag(c diag(a)^-1 b)`` in place of 0, see
    `regularized`."""
    diagonal = jnp.diagonal(a, axis1=-2, axis2=-1)[..., None]
    scale = jnp.sum(jnp.swapaxes(c, -1, -2) * b / jnp.where(diagonal == 0, 1.0, diagonal), axis=-2)
    corner = -REGULARIZATION * scale[..., None] * np.eye(b.shape[-1])
    return jnp.concatenate([jnp.concatenate([a, b], axis=-1), jnp.concatenate([c, corner], axis=-1)], axis=-2)

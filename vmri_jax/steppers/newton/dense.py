"""Newton direction by one dense factorisation over all unknowns of the macro step: O(num_micro^3).

The way of the reference paper; kept as baseline and oracle.
"""

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from vmri_jax.schemes.equations import Unknowns
from vmri_jax.steppers.newton.linearization import Blocks, apply


def assemble(blocks: Blocks, like: Unknowns):
    """The matrix over all unknowns in a row; `like` gives their shapes."""
    flat, unravel = ravel_pytree(like)
    return jax.vmap(lambda e: ravel_pytree(apply(blocks, unravel(e)))[0])(jnp.eye(flat.size)).T


def factor(blocks: Blocks, like: Unknowns):
    """LU factors of the assembled matrix."""
    return jax.scipy.linalg.lu_factor(assemble(blocks, like))


def solve(factors, residual: Unknowns) -> Unknowns:
    """The direction ``-matrix^-1 residual``."""
    flat, unravel = ravel_pytree(residual)
    return unravel(-jax.scipy.linalg.lu_solve(factors, flat))

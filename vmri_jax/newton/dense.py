"""Newton direction by one dense solve over all unknowns of the macro step: O(num_micro^3).

The way of the reference paper; kept as baseline and oracle.
"""

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from vmri_jax.equations import Unknowns
from vmri_jax.linearization import Blocks, apply


def solve(blocks: Blocks, residual: Unknowns) -> Unknowns:
    """The direction ``-matrix^-1 residual`` from the assembled matrix."""
    flat, unravel = ravel_pytree(residual)
    columns = jax.vmap(lambda e: ravel_pytree(apply(blocks, unravel(e)))[0])(jnp.eye(flat.size))
    return unravel(-jnp.linalg.solve(columns.T, flat))

"""Memory layout of batches: under ``jax.vmap`` the batch axis becomes the contiguous one.

A batch of short vectors, (batch, 6) row by row, gives the compiler loops over six numbers; stored column by column it
gives loops over the batch, which fill vector registers.
"""

import jax
from jax.experimental.layout import Layout, with_layout_constraint


@jax.custom_batching.custom_vmap
def _contiguous(x):
    return x


@_contiguous.def_vmap
def _batched(axis_size, in_batched, x):
    if in_batched[0] and x.ndim > 1:
        x = with_layout_constraint(x, Layout(major_to_minor=(*range(1, x.ndim), 0)))
    return x, in_batched[0]


def contiguous_lanes(tree):
    """The same arrays; in a batch, stored with the batch axis contiguous. Not to be differentiated in reverse mode."""
    return jax.tree.map(_contiguous, tree)

"""Rows of constraints that are scalar products of two vectors, each an affine function of the coordinates of bodies.

With the triples ``z = (phi, d_1, d_2, d_3)`` of each body of an element, one body after the other, the rows are

    g_r = u_r . v_r,    u_r = sum_i U_ri z_i + u_0r,    v_r = sum_i V_ri z_i + v_0r.

The arrays U, V, u_0, v_0 are numbers of the params. The derivative ``dg_r = u_r . dv_r + du_r . v_r`` follows from two sums, so that rows of this
form need few instructions, and the rows of all joints in a scene are one term.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from vmri_jax.mechanics.arrays import library

FRAME = 4
"""Triples of a rigid body: its centre and three directors. A plate, a rod or a point has fewer; zeros take the place of the others."""


def products(count: int, q: Sequence[Any], params: Mapping[str, Any]) -> Any:
    """The rows g (..., count).

    Args:
        count: number of rows.
        q: coordinates (..., 3 + 3 k) of the bodies in each role.
        params: "factors" (..., 2 count, 4 roles) with U, then V, and "offsets" (..., 2 count, 3) with u_0, then v_0.
    """
    xp = library(q, params)
    z = xp.concatenate([_triples(x, xp) for x in q], axis=-2)[..., None, :, :]
    vectors, offsets = xp.sum(params["factors"][..., None] * z, axis=-2), params["offsets"]
    u, v = vectors[..., :count, :] + offsets[..., :count, :], vectors[..., count:, :]
    # v_0 apart: a row with a constant v is linear, and `sizes_of_terms` finds the sizes of the terms that cancel in u
    return xp.sum(u * v + u * offsets[..., count:, :], axis=-1)


def _triples(x, xp):
    """(..., 4, 3) centre and directors, with zeros for directors that a body does not have."""
    z = x.reshape(*x.shape[:-1], -1, 3)
    missing = FRAME - z.shape[-2]
    return xp.pad(z, [*[(0, 0)] * (z.ndim - 2), (0, missing), (0, 0)]) if missing else z

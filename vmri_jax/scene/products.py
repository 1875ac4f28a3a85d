"""Rows of constraints that are scalar products of two vectors, each an affine function of the coordinates of bodies.

With the triples ``z = (phi, d_1, d_2, d_3)`` of each body of an element, one body after the other, the rows and their
derivatives are

    g_r = u_r . v_r,    u_r = sum_i U_ri z_i + u_0r,    v_r = sum_i V_ri z_i + v_0r,
    dg_r = sum_i J_ri . dz_i,    J_ri = V_ri u_r + U_ri v_r.

The arrays U, V, u_0, v_0 are numbers of the params. The rows of all joints in a scene are one term, of few
instructions.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from vmri_jax.mechanics.arrays import library

FRAME = 4
"""Triples of a rigid body: its centre and three directors.

A plate, a rod or a point has fewer; zeros take the place of the others.
"""


def products(count: int, q: Sequence[Any], params: Mapping[str, Any]) -> Any:
    """The rows g (..., count).

    Args:
        count: number of rows.
        q: coordinates (..., 3 + 3 k) of the bodies in each role.
        params: "factors" (..., 2 count, 4 roles) with U, then V, and "offsets" (..., 2 count, 3) with u_0, then v_0.
    """
    xp = library(q, params)
    z = xp.concatenate([_triples(x, xp) for x in q], axis=-2)
    rows = _rows if xp is np else _rows_of_jax
    return rows(count, params["factors"], params["offsets"], z)


def _triples(x, xp):
    """(..., 4, 3) centre and directors, with zeros for directors that a body does not have."""
    z = x.reshape(*x.shape[:-1], -1, 3)
    missing = FRAME - z.shape[-2]
    return xp.pad(z, [*[(0, 0)] * (z.ndim - 2), (0, missing), (0, 0)]) if missing else z


def _vectors(count: int, factors, offsets, z):
    """u, and v without v_0."""
    vectors = (factors[..., None] * z[..., None, :, :]).sum(axis=-2)
    return vectors[..., :count, :] + offsets[..., :count, :], vectors[..., count:, :]


def _rows(count: int, factors, offsets, z):
    u, v = _vectors(count, factors, offsets, z)
    # v_0 apart: a row with a constant v is linear, and `sizes_of_terms` finds the sizes of the terms that cancel in u
    return (u * v + u * offsets[..., count:, :]).sum(axis=-1)


_rows_of_jax = jax.custom_jvp(_rows, nondiff_argnums=(0,))


def _derivative(count: int, primals, tangents):
    """The rows and dg; by autodiff a Jacobian would take the products with U and V once more for each of its
    columns."""
    factors, offsets, z = primals
    *of_numbers, dz = tangents
    # XLA would compute the vectors anew for each entry of J
    u, v = jax.lax.optimization_barrier(_vectors(count, factors, offsets, z))
    v = v + offsets[..., count:, :]
    change = jnp.zeros(u.shape[:-1])
    if not isinstance(dz, SymbolicZero):
        jacobian = factors[..., count:, :, None] * u[..., None, :] + factors[..., :count, :, None] * v[..., None, :]
        change = jnp.einsum("...rsx,...sx->...r", jacobian, dz)
    if not all(isinstance(tangent, SymbolicZero) for tangent in of_numbers):
        d_factors, d_offsets = (jnp.zeros(d.shape) if isinstance(d, SymbolicZero) else d for d in of_numbers)
        vectors = (d_factors[..., None] * z[..., None, :, :]).sum(axis=-2) + d_offsets
        change += (vectors[..., :count, :] * v + vectors[..., count:, :] * u).sum(axis=-1)
    return _rows_of_jax(count, factors, offsets, z), change


_rows_of_jax.defjvp(_derivative, symbolic_zeros=True)

"""Functions of the coordinates of two joined bodies: the gap between the points of the joint, its triads, and its freedoms.

For the letters see `vmri_jax.scene.effects.joints`.
"""

from collections.abc import Iterable, Mapping
from itertools import islice
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from vmri_jax.scene.terms import Applied, place, split

Freedom = Literal["turn", "slide", "tilt", "along", "across"]
"""In this order: the angle about the axis n, the distance along n, the angle about the second axis e, the distances along m and m'."""


def gap(q, params):
    """``D = phi_b + rho_b - phi_a - rho_a``, (..., 3) m."""
    a, b = q
    return place(b, params["point_b"]) - place(a, params["point_a"])


def triads(q, params):
    """``(m, m', n)`` of a and ``(e, e', f)`` of b in space, (..., 3, 3) with one vector per row."""
    return tuple(params[f"frame_{role}"] @ split(x)[1] for role, x in zip("ab", q, strict=True))


M, M_PRIME, N = range(3)
"""Rows of a triad."""


def by_sine(sine, cosine, q, params):
    """Sine and cosine of an angle, times a common factor near 1, as products of a vector of a and a vector of b; each by the numbers of both vectors."""
    of_a, of_b = triads(q, params)
    return tuple((of_a[..., i, :] * of_b[..., j, :]).sum(axis=-1) for i, j in (sine, cosine))


def angle(sine_and_cosine, q, params):
    """The angle, rad, between -pi and pi."""
    return jnp.arctan2(*sine_and_cosine(q, params))


def distance(axis, q, params):
    """How far b has moved from the given position along a vector of the triad of a, as ``n . D``, m, (...)."""
    return (triads(q, params)[0][..., axis, :] * gap(q, params)).sum(axis=-1)


ANGLES: dict[str, Any] = {
    "turn": Applied(by_sine, ((M_PRIME, M), (M, M))),  # m' . e, m . e
    "tilt": Applied(by_sine, ((N, M_PRIME), (N, N))),  # n . e', n . f
}
"""For each freedom that is an angle, the function that gives its sine and cosine."""
FREEDOMS: dict[str, Any] = {
    "turn": Applied(angle, (ANGLES["turn"],)),
    "slide": Applied(distance, (N,)),
    "tilt": Applied(angle, (ANGLES["tilt"],)),
    "along": Applied(distance, (M,)),
    "across": Applied(distance, (M_PRIME,)),
}
"""For each freedom, the function ``(q, params) -> (...)`` of the coordinates of both bodies that gives its value against the given position."""
REACH = 5 * np.pi / 6
"""rad: an effect that counts whole turns may take an angle from directors up to this size. Directors know angles up to whole turns; the gap of
a third of a turn between REACH and -REACH is too wide to be jumped over by a run with six steps in a turn. A larger value narrows the gap."""


def within_reach(freedom, q, params):
    """An angle, rad; beyond `REACH` NaN with all its derivatives, which ends a run in place of a wrong number of turns."""
    angle = freedom(q, params)
    return angle * jnp.where(jnp.abs(angle) < REACH, 1.0, jnp.nan)


def coordinate(q, params):
    """A freedom that is a coordinate of the scene, ``q = ((..., 1),)``."""
    return q[0][..., 0]


def freedoms_of(functions: tuple[Any, ...], q: Iterable[Any], params: Mapping[str, Any]) -> tuple[Any, ...]:
    """Freedoms by these functions, of the coordinate of each or of the coordinates of both bodies of its joint."""
    roles, frames = iter(q), params.get("joints", (params,))
    sizes = (1 if function is coordinate else 2 for function in functions)
    of_each = zip(functions, sizes, frames, strict=True)
    return tuple(function(tuple(islice(roles, size)), of_joint) for function, size, of_joint in of_each)

"""Functions of the coordinates of two joined bodies: the gap between the points of the joint, its triads, and its freedoms.

For the letters see `vmri_jax.scene.effects.joints`.
"""

from collections.abc import Iterable, Mapping
from itertools import islice
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from vmri_jax.scene.terms import place, split

Freedom = Literal["turn", "slide", "tilt", "along", "across"]
"""In this order: the angle about the axis n, the distance along n, the angle about the second axis e, the distances along m and m'."""


def gap(q, params):
    """``D = phi_b + rho_b - phi_a - rho_a``, (..., 3) m."""
    a, b = q
    return place(b, params["point_b"]) - place(a, params["point_a"])


def triads(q, params):
    """``(m, m', n)`` of a and ``(e, e', f)`` of b in space, (..., 3, 3) with one vector per row."""
    return tuple(params[f"frame_{role}"] @ split(x)[1] for role, x in zip("ab", q, strict=True))


def dot(u, v):
    """``u . v`` over the last axis."""
    return (u * v).sum(axis=-1)


M, M_PRIME, N = range(3)
"""Rows of a triad."""


def turn_by_sine(q, params):
    """``(m' . e, m . e)``: sine and cosine of the angle by which b has turned about n from the given position, times a common factor near 1."""
    of_a, of_b = triads(q, params)
    e = of_b[..., M, :]
    return dot(of_a[..., M_PRIME, :], e), dot(of_a[..., M, :], e)


def tilt_by_sine(q, params):
    """``(n . e', n . f)``: sine and cosine of the angle by which b has turned about its axis e from the given position, times a common factor near 1."""
    of_a, of_b = triads(q, params)
    n = of_a[..., N, :]
    return dot(of_b[..., M_PRIME, :], n), dot(of_b[..., N, :], n)


def slide(q, params, axis: int = N):
    """How far b has moved from the given position along n, or along another vector of the triad of a: ``n . D``, m, (...)."""
    return dot(triads(q, params)[0][..., axis, :], gap(q, params))


ANGLES: dict[str, Any] = {"turn": turn_by_sine, "tilt": tilt_by_sine}
"""For each freedom that is an angle, the function that gives its sine and cosine."""
REACH = 5 * np.pi / 6
"""rad: an effect that counts whole turns may take an angle from directors up to this size. Directors know angles up to whole turns; the gap of
a third of a turn between REACH and -REACH is too wide to be jumped over by a run with six steps in a turn. A larger value narrows the gap."""
COORDINATE = "coordinate"
"""In `FREEDOMS`, the name of any freedom that is a coordinate of the scene, ``q = ((..., 1),)``."""
FREEDOMS: dict[str, Any] = {
    "turn": lambda q, params: jnp.arctan2(*turn_by_sine(q, params)),
    "slide": slide,
    "tilt": lambda q, params: jnp.arctan2(*tilt_by_sine(q, params)),
    "along": lambda q, params: slide(q, params, M),
    "across": lambda q, params: slide(q, params, M_PRIME),
    COORDINATE: lambda q, params: q[0][..., 0],
}
"""For each freedom, the function ``(q, params) -> (...)`` of the coordinates of both bodies that gives its value against the given position: rad,
between -pi and pi, or m."""


def within_reach(angle):
    """The angle, rad; beyond `REACH` NaN with all its derivatives, which ends a run in place of a wrong number of turns."""
    return angle * jnp.where(jnp.abs(angle) < REACH, 1.0, jnp.nan)


IN_REACH = {freedom: f"{freedom} within reach" for freedom in ANGLES}
"""For each angle, the name in `FREEDOMS` of the same angle `within_reach`."""
SINES = {freedom: f"sine and cosine of {freedom}" for freedom in ANGLES}
"""For each angle, the name in `FREEDOMS` of its function in `ANGLES`."""
FREEDOMS |= {SINES[freedom]: function for freedom, function in ANGLES.items()} | {
    name: lambda q, params, angle=FREEDOMS[freedom]: within_reach(angle(q, params))
    for freedom, name in IN_REACH.items()
}


def freedoms_of(names: tuple[str, ...], q: Iterable[Any], params: Mapping[str, Any]) -> tuple[Any, ...]:
    """The freedoms with these names in `FREEDOMS`, by the coordinate of each or by the coordinates of both bodies of its joint."""
    roles, frames = iter(q), params.get("joints", (params,))
    sizes = (1 if name == COORDINATE else 2 for name in names)
    of_each = zip(names, sizes, frames, strict=True)
    return tuple(FREEDOMS[name](tuple(islice(roles, size)), of_joint) for name, size, of_joint in of_each)

"""What joints measure: the gap between their points, their triads, and the freedoms that they leave, by the coordinates of two bodies.

Letters are those of `vmri_jax.scene.effects.joints`.
"""

from typing import Any, Literal

import jax.numpy as jnp

from vmri_jax.scene.rigid import split

Freedom = Literal["turn", "slide", "tilt", "along", "across"]
"""An angle about the axis n, a way along it, an angle about the second axis e, ways along m and m' of a plane."""


def place(q, weights):
    """``phi + sum_i X_i d_i``, (..., 3)."""
    phi, d = split(q)
    return phi + jnp.sum(weights[..., : d.shape[-2], None] * d, axis=-2)


def gap(q, params):
    """``D``, (..., 3)."""
    a, b = q
    return place(b, params["point_b"]) - place(a, params["point_a"])


def triads(q, params):
    """``(m, m', n)`` of a and ``(e, e', f)`` of b in space, (..., 3, 3) with one vector per row."""
    return tuple(params[f"frame_{role}"] @ split(x)[1] for role, x in zip("ab", q, strict=True))


def dot(u, v):
    """``u . v`` over the last axis."""
    return jnp.sum(u * v, axis=-1)


def aligned(q, params, *pairs: tuple[int, int]):
    """Products of the i-th vector of a with the j-th of b, (..., number of pairs)."""
    of_a, of_b = triads(q, params)
    return jnp.stack([dot(of_a[..., i, :], of_b[..., j, :]) for i, j in pairs], axis=-1)


M, M_PRIME, N = range(3)
"""Rows of a triad."""
PARALLEL = ((N, M), (N, M_PRIME))
"""Products that vanish where the axes of both bodies are parallel."""
UNTURNED = (M, M_PRIME)
"""The product that vanishes where b has not turned about the axis."""


def across(q, params):
    """``(m . D, m' . D)``, (..., 2)."""
    apart, (of_a, _) = gap(q, params), triads(q, params)
    return jnp.stack([dot(of_a[..., i, :], apart) for i in (M, M_PRIME)], axis=-1)


def turn_by_sine(q, params):
    """``(m' . e, m . e)``: sine and cosine of the angle by which b has turned about the axis since the start, times one factor."""
    of_a, of_b = triads(q, params)
    e = of_b[..., M, :]
    return dot(of_a[..., M_PRIME, :], e), dot(of_a[..., M, :], e)


def tilt_by_sine(q, params):
    """``(n . e', n . f)``: sine and cosine of the angle by which b has turned about its own axis e since the start, times one factor."""
    of_a, of_b = triads(q, params)
    n = of_a[..., N, :]
    return dot(of_b[..., M_PRIME, :], n), dot(of_b[..., N, :], n)


def turn(q, params):
    """The angle by which b has turned about the axis since the start, rad, between -pi and pi, (...)."""
    return jnp.arctan2(*turn_by_sine(q, params))


def tilt(q, params):
    """The angle by which b has turned about its own axis e since the start, rad, between -pi and pi, (...)."""
    return jnp.arctan2(*tilt_by_sine(q, params))


def slide(q, params):
    """How far b has moved along the axis since the start, ``n . D``, m, (...)."""
    return dot(triads(q, params)[0][..., N, :], gap(q, params))


def along_m(q, params):
    """How far b has moved along m since the start, ``m . D``, m, (...)."""
    return across(q, params)[..., 0]


def along_m_prime(q, params):
    """How far b has moved along m' since the start, ``m' . D``, m, (...)."""
    return across(q, params)[..., 1]


ANGLES: dict[str, Any] = {"turn": turn_by_sine, "tilt": tilt_by_sine}
"""Sine and cosine of the freedoms that are angles."""
FREEDOMS: dict[str, Any] = {
    "turn": turn,
    "slide": slide,
    "tilt": tilt,
    "along": along_m,
    "across": along_m_prime,
}
"""What a joint can leave free."""

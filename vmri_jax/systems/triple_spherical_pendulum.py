"""The triple spherical pendulum: a heavy bob on a rod (slow), two light ones on a rod and a stiff spring (fast)."""

import jax.numpy as jnp

from vmri_jax.mechanics.arrays import library
from vmri_jax.mechanics.names import Names
from vmri_jax.mechanics.state import Problem
from vmri_jax.mechanics.system import ConstantMass, System
from vmri_jax.systems.drawn import point


def weight(q_s, q_f, params):
    """``V = g sum_i m_i z_i``."""
    heights = jnp.concatenate([q_s, q_f])[2::3]
    return params["gravity"] * jnp.sum(params["masses"] * heights)


def spring(q_f, params):
    """``W = k/2 (|q_3 - q_2| - l_3)^2``."""
    stretch = jnp.linalg.norm(q_f[3:] - q_f[:3]) - params["lengths"][2]
    return params["stiffness"] / 2 * stretch**2


def quartic_spring(q_f, params):
    """``W = k/2 (|q_3 - q_2|^2 - l_3^2)^2``."""
    stretch = jnp.sum((q_f[3:] - q_f[:3]) ** 2) - params["lengths"][2] ** 2
    return params["stiffness"] / 2 * stretch**2


def first_rod(q_s, params):
    """``g_s = (|q_1|^2 - l_1^2) / 2``."""
    return (jnp.sum(q_s**2, keepdims=True) - params["lengths"][0] ** 2) / 2


def second_rod(q_s, q_f, params):
    """``g = (|q_2 - q_1|^2 - l_2^2) / 2``."""
    return (jnp.sum((q_f[:3] - q_s) ** 2, keepdims=True) - params["lengths"][1] ** 2) / 2


DRAWING = {
    "bodies": [point("heavy bob", "s", 0, 0.9), point("light bob", "f", 0, 0.4), point("last bob", "f", 1, 0.4)],
    "links": [["heavy bob", "light bob"]],
    "springs": [["light bob", "last bob"]],
    "anchors": [{"body": "heavy bob", "point": [0.0, 0.0, 0.0], "kind": "link"}],
}
"""The bobs on two rods, the last one on a stiff spring."""


def triple_spherical_pendulum(
    masses=(100.0, 1.0, 1.0), stiffness=5000.0, lengths=(10.0, 2.0, 3.0), gravity=9.81, quartic=False
) -> Problem:
    """Triple spherical pendulum in R^3: q_1 slow, (q_2, q_3) fast; rods along x and y, spring along z.

    Args:
        masses: of the three bobs.
        stiffness: k of the spring between the second and the third bob.
        lengths: of the first rod, the second rod, and the spring at rest.
        gravity: acceleration along -z.
        quartic: take ``k/2 (|q_3 - q_2|^2 - l_3^2)^2`` for the spring (the reference study may have meant it).
    """
    m_1, m_2, m_3 = masses
    l_1, l_2, l_3 = lengths
    xp = library(masses, stiffness, lengths, gravity)
    params = {"masses": masses, "stiffness": stiffness, "lengths": lengths, "gravity": gravity}
    system = System(
        kinetic=ConstantMass(slow=xp.full(3, m_1), fast=xp.repeat(xp.asarray([m_2, m_3]), 3)),
        slow_potential=weight,
        fast_potential=quartic_spring if quartic else spring,
        constraint=second_rod,
        slow_constraint=first_rod,
        params={name: xp.asarray(value) for name, value in params.items()},
    )
    return Problem(
        system,
        q_s=xp.asarray([l_1, 0.0, 0.0]),
        q_f=xp.asarray([l_1, l_2, 0.0, l_1, l_2, l_3]),
        v_s=[0.0, 1.0, 0.0],
        v_f=[0.0, 1.0, 0.0, 0.0, 1.0, 0.5],
        names=Names({"bob 1": 3}, {"bob 2": 3, "bob 3": 3}, {"rod 2": 1}, {"rod 1": 1}),
        drawing=DRAWING,
    )

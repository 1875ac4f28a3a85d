"""A simple atomic model: two heavy atoms (slow) and four light ones (fast) joined by springs and rigid bonds."""

import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import library
from vmri_jax.mechanics.names import Names
from vmri_jax.mechanics.state import Problem
from vmri_jax.mechanics.system import ConstantMass, System
from vmri_jax.systems.drawn import point

TETRAHEDRON = np.sqrt(np.array([1 / 3, 1 / 12, 2 / 3]))  # with unit edges: circumradius and inradius of a face, height


def length_change(a, b, length):
    """Distance of atoms a and b less `length`, for one pair (3,) or for n pairs (n, 3)."""
    return jnp.linalg.norm(b - a, axis=-1) - length


def slow_forces(q_s, q_f, params):
    """Gravity on all atoms and the soft springs 1-2 and 2-3, ``k/2 (|q_i - q_j| - l)^2``."""
    k, length = params["stiffness"], params["length"]
    springs = k[0] / 2 * length_change(q_s[:3], q_s[3:], length) ** 2
    springs += k[1] / 2 * length_change(q_s[3:], q_f[:3], length) ** 2
    heights = jnp.concatenate([q_s, q_f])[2::3]
    return springs + params["gravity"] * jnp.sum(params["masses"] * heights)


def stiff_springs(q_f, params):
    """The stiff triangle 3-4-5, ``k/2 sum (|q_i - q_j| - l)^2``."""
    a, b = q_f[:9].reshape(3, 3), jnp.concatenate([q_f[3:9], q_f[:3]]).reshape(3, 3)
    return jnp.sum(params["stiffness"][2] / 2 * length_change(a, b, params["length"]) ** 2)


def slow_bond(q_s, params):
    """Rigid bond of atom 1 to the origin, ``(|q_1|^2 - l^2) / 2``."""
    return (jnp.sum(q_s[:3] ** 2, keepdims=True) - params["length"] ** 2) / 2


def bonds(q_s, q_f, params):
    """Rigid bonds 2-4, 2-5 and 3-6, ``(|q_i - q_j|^2 - l^2) / 2``."""
    q_2, q_3 = q_s[3:], q_f[:3]
    bond = q_f[3:].reshape(3, 3) - jnp.concatenate([jnp.tile(q_2, 2), q_3]).reshape(3, 3)
    return (jnp.sum(bond**2, axis=1) - params["length"] ** 2) / 2


DRAWING = {
    "bodies": [
        *(point(f"atom {i + 1}", "s", i, radius) for i, radius in enumerate((2.6, 2.0))),
        *(point(f"atom {i + 3}", "f", i, 1.3) for i in range(4)),
    ],
    "links": [[f"atom {i}", f"atom {j}"] for i, j in ((2, 4), (2, 5), (3, 6))],
    "springs": [[f"atom {i}", f"atom {j}"] for i, j in ((1, 2), (2, 3), (3, 4), (4, 5), (5, 3))],
    "anchors": [{"body": "atom 1", "point": [0.0, 0.0, 0.0], "kind": "link"}],
}
"""Two heavy atoms and four light ones, rigid bonds as links."""


def simple_atomic_model(
    masses=(100.0, 40.0, 1.0, 1.0, 1.0, 1.0), stiffness=(10.0, 1.0, 4000.0), length=10.0, gravity=9.81
) -> Problem:
    """Simple atomic model in R^3: (q_1, q_2) slow, (q_3, ..., q_6) fast; hanging, atoms 2 to 5 a regular tetrahedron.

    The velocities of this problem do not satisfy the bonds: `Problem.state` projects them.

    Args:
        masses: of the six atoms.
        stiffness: of the springs 1-2 (soft), 2-3 (soft) and of the triangle 3-4-5 (stiff).
        length: of all rigid bonds, and of all springs at rest.
        gravity: acceleration along -z.
    """
    radius, inradius, height = length * TETRAHEDRON
    top = -2 * length - height  # z of the face 3-4-5, below atom 2
    q_s = np.array([0.0, 0.0, -length, 0.0, 0.0, -2 * length])
    q_f = np.array(
        [
            [radius, 0.0, top],
            [-inradius, length / 2, top],
            [-inradius, -length / 2, top],
            [radius, 0.0, top - length],
        ]
    )
    xp = library(masses, stiffness, length, gravity)
    params = {"masses": masses, "stiffness": stiffness, "length": length, "gravity": gravity}
    system = System(
        kinetic=ConstantMass(xp.repeat(xp.asarray(masses[:2]), 3), xp.repeat(xp.asarray(masses[2:]), 3)),
        slow_potential=slow_forces,
        fast_potential=stiff_springs,
        constraint=bonds,
        slow_constraint=slow_bond,
        params={name: xp.asarray(value) for name, value in params.items()},
    )
    v_s = np.array([[0.0, 0.5, 0.0], [0.3, 0.2, 0.1]])
    v_f = np.array([[0.0, 0.4, 0.2], [-0.5, 0.2, 0.3], [0.2, -0.6, 0.4], [0.7, 0.1, 0.2]])
    names = Names(
        slow={"atom 1": 3, "atom 2": 3},
        fast={f"atom {i}": 3 for i in (3, 4, 5, 6)},
        constraint={"bond 2-4": 1, "bond 2-5": 1, "bond 3-6": 1},
        slow_constraint={"bond 1": 1},
    )
    start = (xp.asarray(a).reshape(-1) for a in (q_s, q_f, v_s, v_f))
    return Problem(system, *start, project=True, names=names, drawing=DRAWING)

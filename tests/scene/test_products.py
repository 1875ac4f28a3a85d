"""Rows of joints and of rigidity as products of vectors, against the vectors themselves and against derivatives by JAX,
at random coordinates."""

from typing import Any

import jax
import numpy as np

from vmri_jax import scene as sc
from vmri_jax.scene.effects.joint_base import Joint
from vmri_jax.scene.rows import ConstraintRows
from vmri_jax.scene.terms import place, split

RANDOM = np.random.default_rng(0)
X, Y, Z = np.eye(3)
AT, TOP = [0.6, 0.1, 0.2], np.array([0.0, 0.0, 2.0])
BODIES = [
    *(sc.RigidBody(name, 1.0, [1.0, 2.0, 2.5], RANDOM.normal(size=3), RANDOM.normal(size=3)) for name in "abcdefgh"),
    sc.RigidBody("plate", 1.0, [1.0, 1.0, 2.0], Z),
    sc.Body("point", 1.0, TOP),
]
JOINTS = [
    sc.Revolute([("a", "b"), ("ground", "c"), ("d", "ground")], AT, [1.0, 2.0, 3.0]),
    sc.Universal(("b", "c"), AT, X, Y),
    sc.Fixed(("d", "e"), AT),
    sc.Cylindrical(("ground", "e"), AT, Y),
    sc.Prismatic(("f", "e"), AT, [0.0, 1.0, 1.0]),
    sc.Screw([("f", "g"), ("ground", "g")], AT, Y, 0.7),
    sc.Planar(("g", "h"), AT, Y),
    sc.Spherical([("h", "point"), ("plate", "h")], [TOP, Z]),
    sc.RigidLink((("plate", [0.1, 0.2, 0.0]), "point")),
]
SCENE = sc.Scene(BODIES, JOINTS, coordinates="directors", redundant="drop")
"""Each joint has a pair with another kind of body, or with the ground."""
ROWS: Any = ConstraintRows.of(SCENE.sorting)
Q = RANDOM.normal(size=ROWS.sorting.positions.size)


def test_rows_are_the_products_of_the_table():
    """Each row of a joint is the product of two of the vectors D, m, m', n, e, e', f and x, y, z, which the joint has
    by name."""
    values, _ = ROWS.evaluate(0.0, Q)
    coordinates = {name: Q[place.start : place.start + place.size] for name, place in SCENE.places.items()}
    coordinates["ground"] = np.append(np.zeros(3), np.eye(3))
    for joint in [part.effect for part in SCENE.sorting.placed if isinstance(part.effect, Joint)]:
        of_joint = [value for value, row in zip(values, ROWS.rows, strict=True) if row.effect is joint]
        expected = []
        for i in [i for group in joint.groups() for i in group]:
            q = [coordinates[name] for name in joint.elements[i]]
            of_a, of_b = (of_role[i, :, 1:] for of_role in joint.vectors)
            vectors = dict(zip("xyz", np.eye(3), strict=True)) | {"D": place(q[1], of_b[0]) - place(q[0], -of_a[0])}
            if joint.triads is not None:
                vectors |= zip(("m", "m'", "n"), of_a[1:] @ split(q[0])[1], strict=True)
                vectors |= zip(("e", "e'", "f"), of_b[1:] @ split(q[1])[1], strict=True)
            rows = sc.Cylindrical.rows if isinstance(joint, sc.Screw) else joint.rows
            expected += [vectors[u] @ vectors[v] for u, v in rows]
            if isinstance(joint, sc.Screw):
                angle = 2 * np.pi * vectors["n"] @ vectors["D"] / 0.7
                expected.append(
                    vectors["m'"] @ vectors["e"] * np.cos(angle) - vectors["m"] @ vectors["e"] * np.sin(angle)
                )
        np.testing.assert_allclose(of_joint, expected, rtol=0, atol=1e-13)


def test_derivatives_of_rows_are_those_of_jax():
    """The complex step of NumPy against `jax.jvp` of the constraints of the system, along a random direction."""
    system, kept, direction = SCENE.system(), ROWS.numbers(), RANDOM.normal(size=Q.size)
    along = jax.jit(lambda q, v: jax.jvp(lambda q: system.constraints(0.0, q, q[:0]), (q,), (v,)))
    values, jacobian = (a[kept] for a in ROWS.evaluate(0.0, Q))
    by_jax = along(Q, direction)
    np.testing.assert_allclose(values, by_jax[0], rtol=0, atol=1e-13)
    np.testing.assert_allclose(jacobian @ direction, by_jax[1], rtol=0, atol=1e-12)

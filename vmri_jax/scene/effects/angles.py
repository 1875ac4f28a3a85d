"""Potentials of three and four points: angles, bending, torsion."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import library
from vmri_jax.scene.body import end_of
from vmri_jax.scene.declare import effect_class, names, number, positive
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.effects.springs import elastic_energy


class _AmongPoints(Effect):
    """Base class of the potentials here: between different points in the plane or in space."""

    kind = "potential"
    dimensions = (2, 3)
    apart = True


def cosine(q):
    """Cosine of the angle at b between a and c."""
    a, b, c = q
    u, w = a - b, c - b
    return (u * w).sum(axis=-1) / library(q).sqrt((u**2).sum(axis=-1) * (w**2).sum(axis=-1))


def angle_between(q, params=None):
    """Angle at b between a and c, rad."""
    return library(q).arccos(cosine(q))


@effect_class
class Angle(_AmongPoints):
    """Angles with a rest value, ``V = sum k/2 (theta - theta_0)^2``, theta at b between a and c.

    Args:
        between: names (a, b, c), or a list of such.
        stiffness: k, N m, positive; one number, or one for each angle.
        angle: theta_0, rad, between 0 and pi, where the energy is smooth (take `Bending` for pi); likewise. The angle at the positions in
            `bodies` by default.
    """

    between: Any = names(3)
    stiffness: Any = positive()
    angle: Any = number(default=None, measured=True)

    default_name = "angles"
    rest = staticmethod(angle_between)

    @staticmethod
    def function(q, params):
        return elastic_energy(params["stiffness"], angle_between(q) - params["angle"])

    def check_parameters(self):
        super().check_parameters()
        angle = self.parameters["angle"]
        expected = "it must lie between 0 and pi, where the energy is smooth; for pi take Bending"
        self.require((angle > 1e-3) & (angle < np.pi - 1e-3), "angle", angle, expected)


@effect_class
class Bending(_AmongPoints):
    """Resistance to bending of a straight line of points, ``V = sum k (1 + cos theta)``, theta at b between a and c.

    ``k/2 (pi - theta)^2`` near the straight line, and smooth there.

    Args:
        between: names (a, b, c), or a list of such.
        stiffness: k, N m, positive; one number, or one for each.
    """

    between: Any = names(3)
    stiffness: Any = positive()

    @staticmethod
    def function(q, params):
        return jnp.sum(params["stiffness"] * (1 + cosine(q)))


@effect_class
class Torsion(_AmongPoints):
    """Torsion about the middle one of three bonds, ``V = sum k (1 - cos(m (phi - phi_0)))``, phi the dihedral angle.

    phi is 0 if a and d are on the same side of b-c (cis), and pi if they are on opposite sides (trans).

    Args:
        between: names (a, b, c, d) of points in space that are not on a line, or a list of such.
        stiffness: k, N m; one number, or one for each. Negative ones make phi_0 a maximum, as in the OPLS series.
        angle: phi_0, rad, of a minimum; likewise.
        multiplicity: m, a positive integer, the number of minima in a turn; likewise.
    """

    between: Any = names(4)
    stiffness: Any = number()
    angle: Any = number(default=0.0)
    multiplicity: Any = positive(default=1)

    dimensions = (3,)

    @staticmethod
    def function(q, params):
        a, b, c, d = q
        # with b_1 = b - a, b_2 = c - b, b_3 = d - c: tan phi = |b_2| b_1 . (b_2 x b_3) / ((b_1 x b_2) . (b_2 x b_3))
        first, axis, last = b - a, c - b, d - c
        left, right = jnp.cross(first, axis), jnp.cross(axis, last)
        sine = jnp.linalg.norm(axis, axis=-1) * jnp.sum(first * right, axis=-1)
        phi = jnp.arctan2(sine, jnp.sum(left * right, axis=-1))
        return jnp.sum(params["stiffness"] * (1 - jnp.cos(params["multiplicity"] * (phi - params["angle"]))))

    def check_parameters(self):
        super().check_parameters()
        multiplicity = self.parameters["multiplicity"]
        self.require(
            multiplicity == library(multiplicity).round(multiplicity),
            "multiplicity",
            multiplicity,
            "it must be an integer",
        )
        expected = "they must not start on a line, where there is no dihedral angle"
        for element in self.elements:
            for corner in (element[:3], element[1:]):
                a, b, c = (end_of(self.by_name, name).position for name in corner)
                xp = library(a, b, c)
                area, size = xp.linalg.norm(xp.cross(b - a, c - b)), xp.linalg.norm(b - a) * xp.linalg.norm(c - b)
                self.require(area > 1e-9 * size, f"the area between {', '.join(corner)}", area, expected)

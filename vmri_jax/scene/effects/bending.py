"""Terms of three and four points: angles, bending, torsion."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete
from vmri_jax.scene.effect import Effect, groups
from vmri_jax.scene.effects.geometry import check_points, require_apart


def cosine(q):
    """Cosine of the angle at b between a and c."""
    a, b, c = q
    u, w = a - b, c - b
    return jnp.sum(u * w, axis=-1) / jnp.sqrt(jnp.sum(u**2, axis=-1) * jnp.sum(w**2, axis=-1))


def angle_energy(q, params):
    """``V = sum k/2 (theta - theta_0)^2``."""
    return jnp.sum(params["stiffness"] / 2 * (jnp.arccos(cosine(q)) - params["angle"]) ** 2)


def bending_energy(q, params):
    """``V = sum k (1 + cos theta)``."""
    return jnp.sum(params["stiffness"] * (1 + cosine(q)))


@dataclass(frozen=True, eq=False)
class _Angles(Effect):
    """What terms of the angle at the middle one of three points share."""

    between: Any
    stiffness: Any

    kind = "potential"

    def elements(self, bodies):
        return groups(self.between, 3, self.name)

    def parameters(self, bodies):
        return {"stiffness": jnp.asarray(self.stiffness, dtype=float)}

    def check(self, bodies):
        super().check(bodies)
        check_points(self, bodies, (2, 3))
        require_apart(self, bodies, 0, 1)
        require_apart(self, bodies, 1, 2)
        self.require_positive(stiffness=self.stiffness)


@dataclass(frozen=True, eq=False)
class Angle(_Angles):
    """Angles with a rest value, ``V = sum k/2 (theta - theta_0)^2``, theta at b between a and c.

    Args:
        between: names (a, b, c), or a list of such.
        stiffness: k, N m, positive; one number, or one for each angle.
        angle: theta_0, rad, between 0 and pi; likewise. The angle at the start by default.

    Raises:
        ValueError: (of the scene) a stiffness that is not positive; a rest angle that is not between 0 and pi, where this
            energy is not smooth (take `Bending` for pi); points that coincide.
    """

    angle: Any = None

    default_name = "angles"
    numbers = ("stiffness", "angle")
    function = staticmethod(angle_energy)

    def parameters(self, bodies):
        angle = self.angle
        if angle is None:
            starts = [[bodies[name].position for name in element] for element in self.elements(bodies)]
            angle = jnp.stack([jnp.arccos(cosine(start)) for start in starts])
            angle = angle[0] if len(starts) == 1 else angle
        return super().parameters(bodies) | {"angle": jnp.asarray(angle, dtype=float)}

    def check(self, bodies):
        super().check(bodies)
        angle = self.parameters(bodies)["angle"]
        if is_concrete(angle):
            inside = (np.asarray(angle) > 1e-3) & (np.asarray(angle) < np.pi - 1e-3)
            self.require(
                inside, "angle", angle, "it must lie between 0 and pi, where the energy is smooth; for pi take Bending"
            )


@dataclass(frozen=True, eq=False)
class Bending(_Angles):
    """Resistance to bending of a straight line of points, ``V = sum k (1 + cos theta)``, theta at b between a and c.

    ``k/2 (pi - theta)^2`` near the straight line, and smooth there.

    Args:
        between: names (a, b, c), or a list of such.
        stiffness: k, N m, positive; one number, or one for each.

    Raises:
        ValueError: (of the scene) a stiffness that is not positive, points that coincide.
    """

    default_name = "bending"
    numbers = ("stiffness",)
    function = staticmethod(bending_energy)


def torsion_energy(q, params):
    """``V = sum k (1 - cos(m (phi - phi_0)))``, phi the dihedral angle of a-b-c-d."""
    a, b, c, d = q
    first, axis, last = b - a, c - b, d - c
    left, right = jnp.cross(first, axis), jnp.cross(axis, last)
    sine = jnp.linalg.norm(axis, axis=-1) * jnp.sum(first * right, axis=-1)
    phi = jnp.arctan2(sine, jnp.sum(left * right, axis=-1))
    return jnp.sum(params["stiffness"] * (1 - jnp.cos(params["multiplicity"] * (phi - params["angle"]))))


@dataclass(frozen=True, eq=False)
class Torsion(Effect):
    """Torsion about the middle one of three bonds, ``V = sum k (1 - cos(m (phi - phi_0)))``, phi the dihedral angle.

    phi is 0 where a and d are on one side of b-c (cis) and pi on opposite ones (trans).

    Args:
        between: names (a, b, c, d) of points in space, or a list of such.
        stiffness: k, N m, positive; one number, or one for each.
        angle: phi_0, rad, of a minimum; likewise.
        multiplicity: m, number of minima in a turn; likewise.

    Raises:
        ValueError: (of the scene) a stiffness that is not positive, a multiplicity that is not a positive integer, points
            that coincide or lie on a line.
    """

    between: Any
    stiffness: Any
    angle: Any = 0.0
    multiplicity: Any = 1

    kind = "potential"
    default_name = "torsion"
    numbers = ("stiffness", "angle", "multiplicity")
    function = staticmethod(torsion_energy)

    def elements(self, bodies):
        return groups(self.between, 4, self.name)

    def parameters(self, bodies):
        return {name: jnp.asarray(getattr(self, name), dtype=float) for name in self.numbers}

    def check(self, bodies):
        super().check(bodies)
        check_points(self, bodies, (3,))
        for a in range(3):
            require_apart(self, bodies, a, a + 1)
        self.require_positive(stiffness=self.stiffness, multiplicity=self.multiplicity)
        multiplicity = self.parameters(bodies)["multiplicity"]
        self.require(multiplicity == jnp.round(multiplicity), "multiplicity", multiplicity, "it must be an integer")
        for element in self.elements(bodies):
            a, b, c, d = (bodies[name].position for name in element)
            for u, w, names in ((b - a, c - b, element[:3]), (c - b, d - c, element[1:])):
                area, size = jnp.linalg.norm(jnp.cross(u, w)), jnp.linalg.norm(u) * jnp.linalg.norm(w)
                what = f"the area between {', '.join(names)}"
                self.require(
                    area > 1e-9 * size, what, area, "they must not start on a line, where there is no dihedral angle"
                )

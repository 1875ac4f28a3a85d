"""Potentials between several points: Newton's gravity, Coulomb, Lennard-Jones, angles, bending, torsion; smooth penalty
contact with planes and spheres."""

from collections.abc import Iterable, Mapping
from dataclasses import KW_ONLY, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete, library, real_array
from vmri_jax.mechanics.checks import check_type
from vmri_jax.mechanics.names import unknown
from vmri_jax.refusals import Refused
from vmri_jax.scene.body import end_of
from vmri_jax.scene.declare import array, common, names, number, positive, real_tree, stacked
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.effects.springs import distance, elastic_energy


class NBodyGravity(Effect):
    """Newton's gravity between bodies, ``V = -G sum_{a<b} m_a m_b / sqrt(|q_a - q_b|^2 + s^2)``.

    Args:
        constant: G, in the units of the scene: 6.674e-11 N m^2/kg^2 in SI units.
        between: names of bodies, every pair of which attracts; or a list of pairs. All bodies by default.
        softening: s, a length; zero for points, which must not start at one place.
    """

    constant: Any = array(default=6.674e-11)
    between: Any = names(2, pairs=True, default=None)
    softening: Any = number(default=0.0)

    kind = "potential"
    default_name = "nbody_gravity"
    masses = ("mass_a", "mass_b")

    @staticmethod
    def function(q, params):
        a, b = q
        softened = jnp.sqrt(jnp.sum((b - a) ** 2, axis=-1) + params["softening"] ** 2)
        return -params["constant"] * jnp.sum(params["mass_a"] * params["mass_b"] / softened)

    @property
    def apart(self):
        return not (is_concrete(self.softening) and np.all(np.asarray(self.softening) > 0))


class _Nonbonded(Effect):
    """Base class of potentials between pairs of points, without the pairs in `exclude`."""

    exclude: Any = field(default=(), kw_only=True)

    kind = "potential"
    dimensions = (1, 2, 3)
    apart = True

    def _elements(self):
        pairs = super()._elements()
        known, left_out = {name for pair in pairs for name in pair}, set()
        for pair in self.exclude:
            if isinstance(pair, str) or len(pair) != 2:
                raise Refused(
                    f"{self.name}: {pair!r} is in exclude; give pairs of names, as from within_bonds(bonds, 3)."
                )
            for name in pair:
                if name not in self.by_name:
                    raise Refused(f"{self.name}: exclude: {unknown('body', name, sorted(known))}")
            left_out.add(frozenset(pair))
        kept = tuple(pair for pair in pairs if frozenset(pair) not in left_out)
        if not kept:
            raise Refused(f"{self.name}: exclude leaves no pair; leave the effect out.")
        return kept


def within_bonds(bonds: Iterable[tuple[str, str]], number: int = 3) -> list[tuple[str, str]]:
    """Pairs of bodies with at most `number` bonds between them, for `exclude` of `LennardJones` and `Coulomb`.

    One bond is between neighbours, two bonds between the ends of an angle, three between the ends of a torsion.

    Args:
        bonds: pairs of names.
        number: largest number of bonds on the shortest path between the bodies of a pair.
    """
    near: dict[str, set[str]] = {}
    for a, b in bonds:
        near.setdefault(a, set()).add(b)
        near.setdefault(b, set()).add(a)
    pairs = set()
    for start in near:
        reached = {start}
        for _ in range(number):
            reached = reached.union(*(near[name] for name in reached))
        pairs |= {(min(start, name), max(start, name)) for name in reached - {start}}
    return sorted(pairs)


class Coulomb(_Nonbonded):
    """Coulomb's law between charges, ``V = C sum_{a<b} Q_a Q_b / |q_b - q_a|``.

    Args:
        charges: Q by name of the body, a dictionary with all bodies of `between`.
        constant: C, in the units of the scene: 8.99e9 N m^2/C^2 in SI units.
        between: a list of pairs; all pairs of the charges by default.
        exclude: pairs without this force, see `within_bonds`.
    """

    charges: Any
    constant: Any = array(default=8.9875517862e9)
    between: Any = names(2, pairs=True, default=None)

    derived = ("charge_a", "charge_b")

    def __post_init__(self):
        super().__post_init__()
        if self.between is None and isinstance(self.charges, Mapping):
            object.__setattr__(self, "between", tuple(self.charges))

    @staticmethod
    def function(q, params):
        return params["constant"] * jnp.sum(params["charge_a"] * params["charge_b"] / distance(q))

    def _elements(self):
        check_type(
            f"{self.name}: charges", self.charges, Mapping, "a dictionary of charges by name of the body, {'a': 1e-6}"
        )
        pairs = super()._elements()
        for name in (name for pair in pairs for name in pair):
            if name not in self.charges:
                raise Refused(f"{self.name}: {name} has no charge; there are charges of {', '.join(self.charges)}.")
        return pairs

    def _parameters(self):
        charges = real_tree(f"{self.name}: charges", self.charges)
        roles = zip(self.derived, zip(*self.elements, strict=True), strict=True)
        of_roles = {name: stacked([charges[body] for body in role]) for name, role in roles}
        return super()._parameters() | of_roles


class LennardJones(_Nonbonded):
    """Lennard-Jones forces, ``V = 4 eps sum_{a<b} ((s/r)^12 - (s/r)^6)``; the minimum -eps is at ``r = 2^(1/6) s``.

    Args:
        depth: eps, J, positive; one number, or one for each pair.
        distance: s, m, positive; likewise.
        between: names of bodies, every pair of which interacts; or a list of pairs. All bodies by default, bonded ones
            too.
        exclude: pairs without this force, see `within_bonds`.
    """

    depth: Any = positive()
    distance: Any = positive()
    between: Any = names(2, pairs=True, default=None)

    default_name = "lennard_jones"

    @staticmethod
    def function(q, params):
        a, b = q
        sixth = (params["distance"] ** 2 / jnp.sum((b - a) ** 2, axis=-1)) ** 3
        return jnp.sum(4 * params["depth"] * (sixth**2 - sixth))


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


class Angle(_AmongPoints):
    """Angles with a rest value, ``V = sum k/2 (theta - theta_0)^2``, theta at b between a and c.

    Args:
        between: names (a, b, c), or a list of such.
        stiffness: k, N m, positive; one number, or one for each angle.
        angle: theta_0, rad, between 0 and pi, where the energy is smooth (take `Bending` for pi); likewise. The angle
            at the positions in `bodies` by default.
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


def penalty(gap, params):
    """``k/2 d^2`` of the smooth depth ``d = s log(1 + exp(-gap / s))``: about -gap if the bodies overlap, decaying like
    ``s exp(-gap / s)`` outside."""
    depth = params["smoothing"] * jax.nn.softplus(-gap / params["smoothing"])
    return jnp.sum(params["stiffness"] / 2 * depth**2)


class _Contact(Effect):
    """Base class of contacts: stiffness, smoothing, and radius of the bodies."""

    _: KW_ONLY
    stiffness: Any = positive()
    smoothing: Any = positive()
    radius: Any = number(default=0.0, sign="at least zero")
    bodies: Any = names(default=None)

    kind = "potential"
    dimensions = (1, 2, 3)

    def curvature(self):
        return self.stiffness

    def drawing(self):
        elements = self.elements
        radii = np.broadcast_to(np.asarray(self.radius, dtype=float), len(elements)).tolist()
        return {"radii": [[name, r] for (name,), r in zip(elements, radii, strict=True) if r > 0]}


class PlaneContact(_Contact):
    """Contact with the side of a plane that its normal points to: ``V = k/2 sum d^2``,
    ``d = s log(1 + exp(-gap / s))``.

    ``gap = n . (q - p) - r``. The energy has derivatives of every order, so that schemes keep their order once the
    steps of its grid resolve the contact.

    Args:
        point: p, (d,), in the plane.
        normal: n, (d,), not zero, towards the free side; scaled to length one.
        stiffness: k, N/m, positive; one number, or one for each body.
        smoothing: s, m, positive: decay length of the force outside of contact.
        radius: r, m, of the bodies; one number, or one for each.
        bodies: names; all bodies of the scene by default.
    """

    _: KW_ONLY
    point: Any = common()
    normal: Any = common()

    default_name = "plane_contact"

    @staticmethod
    def function(q, params):
        (q,) = q
        height = jnp.sum(params["normal"] * (q - params["point"]), axis=-1) / jnp.linalg.norm(params["normal"])
        return penalty(height - params["radius"], params)

    def check_parameters(self):
        normal = real_array(f"{self.name}: normal", self.normal)
        self.require((normal != 0).any(), "normal", self.normal, "it must not be zero")
        super().check_parameters()

    def drawing(self):
        params = self.parameters
        normal = params["normal"] / np.linalg.norm(params["normal"])
        plane = {"point": params["point"].tolist(), "normal": normal.tolist()}
        return super().drawing() | {"planes": [plane]}


class SphereContact(_Contact):
    """Contact with the outside of a fixed sphere: ``V = k/2 sum d^2``, ``d = s log(1 + exp(-gap / s))``.

    ``gap = |q - c| - R - r``.

    Args:
        center: c, (d,); no body may start at it.
        sphere_radius: R, m, positive.
        stiffness, smoothing, radius, bodies: as of `PlaneContact`.
    """

    _: KW_ONLY
    center: Any = common()
    sphere_radius: Any = array(sign="positive")

    default_name = "sphere_contact"

    @staticmethod
    def function(q, params):
        (q,) = q
        distance = jnp.linalg.norm(q - params["center"], axis=-1)
        return penalty(distance - params["sphere_radius"] - params["radius"], params)

    def check_parameters(self):
        super().check_parameters()
        center = self.parameters["center"]
        for (end,) in self.ends:
            differs, expected = (end.position != center).any(), "it must not be the center of the sphere"
            self.require(differs, f"the start of {end.name}", end.position, expected)

    def drawing(self):
        params = self.parameters
        sphere = {"center": params["center"].tolist(), "radius": float(params["sphere_radius"])}
        return super().drawing() | {"spheres": [sphere]}

"""Smooth penalty contact with planes and spheres."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete
from vmri_jax.scene.effect import Effect, each
from vmri_jax.scene.effects.geometry import check_points


def penalty(gap, params):
    """``k/2 d^2`` of the smooth depth ``d = s log(1 + exp(-gap / s))``, which is -gap inside and falls off within s."""
    depth = params["smoothing"] * jax.nn.softplus(-gap / params["smoothing"])
    return jnp.sum(params["stiffness"] / 2 * depth**2)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Contact(Effect):
    """What contacts share: stiffness, smoothing and radius of the bodies."""

    stiffness: Any
    smoothing: Any
    radius: Any = 0.0
    bodies: Any = None

    kind = "potential"
    numbers = ("stiffness", "smoothing", "radius")

    def elements(self, bodies):
        return each(self.bodies, bodies, self.name)

    def parameters(self, bodies):
        return {name: jnp.asarray(getattr(self, name), dtype=float) for name in self.numbers}

    def check(self, bodies):
        super().check(bodies)
        check_points(self, bodies)
        self.require_positive(stiffness=self.stiffness, smoothing=self.smoothing)
        radius = np.asarray(self.radius) if is_concrete(self.radius) else np.zeros(())
        self.require(radius >= 0, "radius", radius, "it must not be negative")

    def curvature(self, bodies):
        return self.stiffness

    def drawing(self, bodies):
        elements = self.elements(bodies)
        radii = np.broadcast_to(np.asarray(self.radius, dtype=float), (len(elements),))
        return {"radii": [[name, float(r)] for (name,), r in zip(elements, radii, strict=True) if r > 0]}


def plane_energy(q, params):
    """`penalty` of ``gap = n . (q - p) - r``."""
    (q,) = q
    return penalty(jnp.sum(params["normal"] * (q - params["point"]), axis=-1) - params["radius"], params)


@dataclass(frozen=True, eq=False, kw_only=True)
class PlaneContact(_Contact):
    """Contact with the side of a plane that its normal points to: ``V = k/2 sum d^2``, ``d = s log(1 + exp(-gap / s))``.

    ``gap = n . (q - p) - r``; smooth to every order, so that schemes keep theirs once H resolves the contact.

    Args:
        point: p, (d,), in the plane.
        normal: n, (d,), towards the free side; scaled to length one.
        stiffness: k, N/m, positive; one number, or one for each body.
        smoothing: s, m, positive: the distance within which the force sets in.
        radius: r, m, of the bodies.
        bodies: names; all bodies of the scene by default.

    Raises:
        ValueError: (of the scene) numbers that are not positive, a normal that is zero, vectors of another dimension.
    """

    point: Any
    normal: Any

    default_name = "plane_contact"
    function = staticmethod(plane_energy)

    def parameters(self, bodies):
        normal = jnp.atleast_1d(jnp.asarray(self.normal, dtype=float))
        point = jnp.atleast_1d(jnp.asarray(self.point, dtype=float))
        return super().parameters(bodies) | {"point": point, "normal": normal / jnp.sqrt(jnp.sum(normal**2))}

    def check(self, bodies):
        self.require(jnp.any(jnp.asarray(self.normal) != 0), "normal", self.normal, "it must not be zero")
        super().check(bodies)
        check_vectors(self, bodies, point=self.point, normal=self.normal)

    def drawing(self, bodies):
        plane = {name: np.asarray(self.parameters(bodies)[name]).tolist() for name in ("point", "normal")}
        return super().drawing(bodies) | {"planes": [plane]}


def sphere_energy(q, params):
    """`penalty` of ``gap = |q - c| - R - r``."""
    (q,) = q
    distance = jnp.sqrt(jnp.sum((q - params["center"]) ** 2, axis=-1))
    return penalty(distance - params["sphere_radius"] - params["radius"], params)


@dataclass(frozen=True, eq=False, kw_only=True)
class SphereContact(_Contact):
    """Contact with the outside of a fixed sphere: ``V = k/2 sum d^2``, ``d = s log(1 + exp(-gap / s))``.

    ``gap = |q - c| - R - r``.

    Args:
        center: c, (d,).
        sphere_radius: R, m, positive.
        stiffness, smoothing, radius, bodies: as of `PlaneContact`.

    Raises:
        ValueError: (of the scene) numbers that are not positive, a center of another dimension, a body that starts at it.
    """

    center: Any
    sphere_radius: Any

    default_name = "sphere_contact"
    function = staticmethod(sphere_energy)

    def parameters(self, bodies):
        center = jnp.atleast_1d(jnp.asarray(self.center, dtype=float))
        return super().parameters(bodies) | {
            "center": center,
            "sphere_radius": jnp.asarray(self.sphere_radius, dtype=float),
        }

    def check(self, bodies):
        super().check(bodies)
        self.require_positive(sphere_radius=self.sphere_radius)
        check_vectors(self, bodies, center=self.center)
        for (name,) in self.elements(bodies):
            away = jnp.any(bodies[name].position != jnp.asarray(self.center))
            self.require(away, f"the start of {name}", bodies[name].position, "it must not be the center of the sphere")

    def drawing(self, bodies):
        parameters = self.parameters(bodies)
        sphere = {"center": np.asarray(parameters["center"]).tolist(), "radius": float(parameters["sphere_radius"])}
        return super().drawing(bodies) | {"spheres": [sphere]}


def check_vectors(effect: Effect, bodies, **vectors) -> None:
    """Refuse vectors that are not of the dimension of all bodies of the effect."""
    for (body,) in effect.elements(bodies):
        for name, value in vectors.items():
            shape = jnp.atleast_1d(jnp.asarray(value)).shape
            if shape != (bodies[body].size,):
                raise ValueError(
                    f"{effect.name}: {name} has shape {shape}, {body} has dimension {bodies[body].size}; they must agree."
                )

"""Smooth penalty contact with planes and spheres."""

from dataclasses import KW_ONLY
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import real_array
from vmri_jax.scene.body import end_of
from vmri_jax.scene.declare import array, common, names, number, positive
from vmri_jax.scene.effect import Effect


def penalty(gap, params):
    """``k/2 d^2`` of the smooth depth ``d = s log(1 + exp(-gap / s))``: about -gap if the bodies overlap, decaying like ``s exp(-gap / s)`` outside."""
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
    """Contact with the side of a plane that its normal points to: ``V = k/2 sum d^2``, ``d = s log(1 + exp(-gap / s))``.

    ``gap = n . (q - p) - r``. The energy has derivatives of every order, so that schemes keep their order once the steps of its grid resolve the contact.

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
        for (name,) in self.elements:
            position = end_of(self.by_name, name).position
            self.require(
                (position != center).any(), f"the start of {name}", position, "it must not be the center of the sphere"
            )

    def drawing(self):
        params = self.parameters
        sphere = {"center": params["center"].tolist(), "radius": float(params["sphere_radius"])}
        return super().drawing() | {"spheres": [sphere]}

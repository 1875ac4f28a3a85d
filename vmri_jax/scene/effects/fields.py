"""Uniform fields: gravity on masses, a magnetic field on moving charges."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from vmri_jax.refusals import Refused
from vmri_jax.scene.body import end_of
from vmri_jax.scene.declare import array, common, effect_class, names, number
from vmri_jax.scene.effect import Effect


@effect_class
class Gravity(Effect):
    """Uniform gravity, ``V = -sum_i m_i g . q_i``.

    Args:
        acceleration: g, (d,) m/s^2; a number g is that acceleration downwards, along the last axis: (0, ..., -g).
        bodies: names of bodies with one mass each; all bodies of the scene by default.
    """

    acceleration: Any = common(default=9.81, may_be_number=True)
    bodies: Any = names(default=None)

    kind = "potential"
    masses = ("mass",)

    @staticmethod
    def function(q, params):
        (q,), g = q, params["acceleration"]
        if jnp.ndim(g) == 0:
            return g * jnp.sum(params["mass"] * q[..., -1])
        return -jnp.sum(params["mass"] * jnp.sum(g * q, axis=-1))

    def drawing(self):
        up = -np.asarray(self.acceleration, dtype=float)
        return {"up": up.tolist()} if up.ndim and up.any() else {}


@effect_class
class MagneticField(Effect):
    """Charges in a uniform magnetic field: ``L = sum Q v . A(q)``, ``A = B x q / 2``, hence the force ``Q v x B``.

    It depends on velocities, so that momenta are ``p = m v + Q A``.

    Args:
        field: B, T, (3,); for bodies in the plane a number, the component out of it.
        charge: Q, C; one number, or one for each body.
        bodies: names; all bodies of the scene by default.
    """

    field: Any = array()
    charge: Any = number()
    bodies: Any = names(default=None)

    kind = "kinetic"
    default_name = "magnetic_field"
    dimensions = (2, 3)

    @staticmethod
    def function(q, v, params):
        (q,), (v,), field = q, v, params["field"]
        if jnp.ndim(field) == 0:
            swept = field * (q[..., 0] * v[..., 1] - q[..., 1] * v[..., 0])
        else:
            swept = jnp.sum(v * jnp.cross(jnp.broadcast_to(field, q.shape), q), axis=-1)
        return jnp.sum(params["charge"] / 2 * swept)

    def check_parameters(self):
        super().check_parameters()
        shape = self.parameters["field"].shape
        for (name,) in self.elements:
            size = end_of(self.by_name, name).size
            needed = () if size == 2 else (3,)
            if shape != needed:
                raise Refused(
                    f"{self.name}: field has shape {shape} and {name} has dimension {size}; give a number in the "
                    "plane, a vector (3,) in space."
                )

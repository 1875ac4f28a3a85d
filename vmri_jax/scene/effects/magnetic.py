"""Charges in a uniform magnetic field."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

from vmri_jax.scene.effect import Effect, each
from vmri_jax.scene.effects.geometry import check_points


def magnetic_term(q, v, params):
    """``L = sum Q/2 v . (B x q)``; in the plane ``L = sum Q B/2 (x v_y - y v_x)``."""
    (q,), (v,), field = q, v, params["field"]
    if jnp.ndim(field) == 0:
        swept = field * (q[..., 0] * v[..., 1] - q[..., 1] * v[..., 0])
    else:
        swept = jnp.sum(v * jnp.cross(jnp.broadcast_to(field, q.shape), q), axis=-1)
    return jnp.sum(params["charge"] / 2 * swept)


@dataclass(frozen=True, eq=False)
class MagneticField(Effect):
    """Charges in a uniform magnetic field: ``L = sum Q v . A(q)``, ``A = B x q / 2``, hence the force ``Q v x B``.

    It depends on velocities, so that momenta are ``p = m v + Q A``.

    Args:
        field: B, T, (3,); for bodies in the plane a number, the component out of it.
        charge: Q, C; one number, or one for each body.
        bodies: names; all bodies of the scene by default.

    Raises:
        ValueError: (of the scene) a field that does not fit the dimension of the bodies.
    """

    field: Any
    charge: Any
    bodies: Any = None

    kind = "kinetic"
    default_name = "magnetic_field"
    numbers = ("charge",)
    function = staticmethod(magnetic_term)

    def elements(self, bodies):
        return each(self.bodies, bodies, self.name)

    def parameters(self, bodies):
        return {"field": jnp.asarray(self.field, dtype=float), "charge": jnp.asarray(self.charge, dtype=float)}

    def check(self, bodies):
        super().check(bodies)
        check_points(self, bodies, (2, 3))
        shape = self.parameters(bodies)["field"].shape
        for (name,) in self.elements(bodies):
            needed = () if bodies[name].size == 2 else (3,)
            if shape != needed:
                raise ValueError(
                    f"{self.name}: field has shape {shape} and {name} has dimension {bodies[name].size}; give a number in the "
                    "plane, a vector (3,) in space."
                )

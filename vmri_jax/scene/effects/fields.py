"""Fields and external forces: gravity on masses, a magnetic field on charges, forces that are constant, functions of time, or turn with two bodies."""

from collections.abc import Callable
from dataclasses import field
from typing import Any

import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.checks import shape_of
from vmri_jax.refusals import Refused
from vmri_jax.scene.body import end_of
from vmri_jax.scene.declare import array, common, names, number, of_time, positive, real_tree, vector
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.effects.points import BetweenPoints


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


class ConstantForce(Effect):
    """A constant force f on bodies.

    Args:
        bodies: a name, or a list of names.
        force: f, N, (d,); or one for each body, (n, d).
    """

    bodies: Any = names()
    force: Any = vector()

    kind = "force"
    default_name = "constant_force"

    @staticmethod
    def function(t, q, v, params):
        return (params["force"],)


class HarmonicDrive(Effect):
    """A harmonic force ``F = f cos(w t + phi)`` on bodies.

    Args:
        bodies: a name, or a list of names.
        amplitude: f, N, (d,); or one for each body, (n, d).
        frequency: w, rad/s, positive; one number, or one for each.
        phase: phi, rad; likewise.
    """

    bodies: Any = names()
    amplitude: Any = vector()
    frequency: Any = positive()
    phase: Any = number(default=0.0)

    kind = "force"
    default_name = "harmonic_drive"

    @staticmethod
    def function(t, q, v, params):
        return (params["amplitude"] * jnp.cos(params["frequency"] * t + params["phase"])[..., None],)


class Drive(Effect):
    """A force ``F = f(t)`` on bodies, any function of time.

    Args:
        bodies: a name, or a list of names; each gets this force.
        history: ``history(t, params) -> (d,)``, N.
        params: of `history`, numbers by name. They may change without a new compilation, and runs have derivatives with respect to them.
    """

    bodies: Any = names()
    history: Callable = of_time()
    params: Any = field(default_factory=dict)

    kind = "force"

    @staticmethod
    def function(history, t, q, v, params):
        return (history(t, params),)

    def _parameters(self):
        params = real_tree(f"{self.name}: params", self.params)
        if not isinstance(params, dict):
            raise Refused(f"{self.name}: params is {self.params!r}; give numbers by name, such as {{'size': 2.0}}.")
        return params | self.points

    def check_parameters(self):
        super().check_parameters()
        value = shape_of(f"{self.name}: history", self.history, jnp.zeros(()), self.parameters)
        shape = getattr(value, "shape", None)
        for (name,) in self.elements:
            size = end_of(self.by_name, name).size
            if shape != (size,) and (shape, size) != ((), 1):
                raise Refused(
                    f"{self.name}: history returns shape {shape}; {name} has dimension {size}, return ({size},)."
                )


class FollowerForce(BetweenPoints):
    """A force on b that turns with the line from a to b: ``F = f (q_b - q_a) / |q_b - q_a|``, a jet at the end of a rod.

    Args:
        between: names (a, b), or a list of such pairs.
        force: f, N; positive pushes b away from a; one number, or one for each.
    """

    force: Any = number()

    kind = "force"
    default_name = "follower_force"

    @staticmethod
    def function(t, q, v, params):
        a, b = q
        direction = (b - a) / jnp.linalg.norm(b - a, axis=-1, keepdims=True)
        return jnp.zeros_like(a), params["force"][..., None] * direction

"""External forces: constant, harmonic, any function of time, and a force that turns with two bodies."""

from collections.abc import Callable
from dataclasses import field
from typing import Any

import jax.numpy as jnp

from vmri_jax.mechanics.checks import shape_of
from vmri_jax.refusals import Refused
from vmri_jax.scene.body import end_of
from vmri_jax.scene.declare import effect_class, names, number, of_time, positive, real_tree, vector
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.effects.points import BetweenPoints
from vmri_jax.scene.terms import Applied


@effect_class
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


@effect_class
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


def same_on_all(history, t, q, v, params):
    """``F = f(t)``, the same on all bodies."""
    (q,) = q
    return (jnp.broadcast_to(history(t, params), q.shape),)


@effect_class
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

    @property
    def function(self):
        return Applied(same_on_all, (self.history,))

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


@effect_class
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

"""Forces from outside: constant, following a direction of the motion, harmonic, and any function of time."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp

from vmri_jax.scene.effect import Effect, groups
from vmri_jax.scene.effects.geometry import check_points, require_apart, vector_of


@dataclass(frozen=True, eq=False)
class _OnBodies(Effect):
    """What forces on single bodies share."""

    bodies: Any

    kind = "force"

    def elements(self, bodies):
        return groups(self.bodies, 1, self.name)


def constant_force(t, q, v, params):
    """``F = f``."""
    return (params["force"],)


@dataclass(frozen=True, eq=False)
class ConstantForce(_OnBodies):
    """A constant force f on bodies.

    Args:
        bodies: a name, or a list of names.
        force: f, N, (d,); or one for each body, (n, d).
    """

    force: Any

    default_name = "constant_force"
    vectors = ("force",)
    function = staticmethod(constant_force)

    def parameters(self, bodies):
        return {"force": vector_of(self, "force", self.force, bodies)}


def harmonic_force(t, q, v, params):
    """``F = f cos(w t + phi)``."""
    return (params["amplitude"] * jnp.cos(params["frequency"] * t + params["phase"])[..., None],)


@dataclass(frozen=True, eq=False)
class HarmonicDrive(_OnBodies):
    """A harmonic force ``F = f cos(w t + phi)`` on bodies.

    Args:
        bodies: a name, or a list of names.
        amplitude: f, N, (d,); or one for each body, (n, d).
        frequency: w, rad/s, positive; one number, or one for each.
        phase: phi, rad; likewise.

    Raises:
        ValueError: (of the scene) a frequency that is not positive.
    """

    amplitude: Any
    frequency: Any
    phase: Any = 0.0

    default_name = "harmonic_drive"
    numbers, vectors = ("frequency", "phase"), ("amplitude",)
    function = staticmethod(harmonic_force)

    def parameters(self, bodies):
        numbers = {name: jnp.asarray(getattr(self, name), dtype=float) for name in self.numbers}
        return numbers | {"amplitude": vector_of(self, "amplitude", self.amplitude, bodies)}

    def check(self, bodies):
        super().check(bodies)
        self.require_positive(frequency=self.frequency)


@dataclass(frozen=True)
class OfTime:
    """``F = f(t)``, the same on all bodies."""

    history: Callable

    def __call__(self, t, q, v, params):
        (q,) = q
        return (jnp.broadcast_to(self.history(t, params), q.shape),)


@dataclass(frozen=True, eq=False)
class Drive(_OnBodies):
    """A force ``F = f(t)`` on bodies, any function of time.

    Args:
        bodies: a name, or a list of names; each gets this force.
        history: ``history(t, params) -> (d,)``; define it at module level, it is compared by identity.
        params: what `history` gets as params; traced.
    """

    history: Callable
    params: Any = field(default_factory=dict)

    default_name = "drive"

    @property
    def function(self):
        return OfTime(self.history)

    def parameters(self, bodies):
        return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype=float), self.params)


def follower_force(t, q, v, params):
    """``F = f (q_b - q_a) / |q_b - q_a|`` on b."""
    a, b = q
    direction = (b - a) / jnp.linalg.norm(b - a, axis=-1, keepdims=True)
    return jnp.zeros_like(a), params["force"][..., None] * direction


@dataclass(frozen=True, eq=False)
class FollowerForce(Effect):
    """A force on b that turns with the line from a to b: ``F = f (q_b - q_a) / |q_b - q_a|``, a jet at the end of a rod.

    Args:
        between: names (a, b), or a list of such pairs.
        force: f, N; positive pushes b away from a; one number, or one for each.

    Raises:
        ValueError: (of the scene) ends at one point at the start.
    """

    between: Any
    force: Any

    kind = "force"
    default_name = "follower_force"
    numbers = ("force",)
    function = staticmethod(follower_force)

    def elements(self, bodies):
        return groups(self.between, 2, self.name)

    def parameters(self, bodies):
        return {"force": jnp.asarray(self.force, dtype=float)}

    def check(self, bodies):
        super().check(bodies)
        check_points(self, bodies)
        require_apart(self, bodies)

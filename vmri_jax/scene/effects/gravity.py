"""Gravity: uniform, and between bodies."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete
from vmri_jax.scene.effect import Effect, all_pairs, each
from vmri_jax.scene.effects.geometry import mass_of, require_apart


def weight(q, params):
    """``V = -sum_i m_i g . q_i``, for a number g downwards along the last axis."""
    (q,), g = q, params["acceleration"]
    if jnp.ndim(g) == 0:
        last = q.shape[-1] - 1
        return g * jnp.sum(params["mass"] * q.reshape(-1)[last :: last + 1])
    return -jnp.sum(params["mass"] * jnp.sum(g * q, axis=-1))


@dataclass(frozen=True, eq=False)
class Gravity(Effect):
    """Uniform gravity, ``V = -sum_i m_i g . q_i``.

    Args:
        acceleration: g, (d,) m/s^2; a number g is that acceleration downwards, along the last axis: (0, ..., -g).
        bodies: names; all bodies of the scene by default.

    Raises:
        ValueError: (of the scene) an acceleration of another dimension than a body.
    """

    acceleration: Any = 9.81
    bodies: Any = None

    kind = "potential"
    default_name = "gravity"
    numbers = ("mass",)
    function = staticmethod(weight)

    def elements(self, bodies):
        return each(self.bodies, bodies, self.name)

    def parameters(self, bodies):
        elements = self.elements(bodies)
        return {"acceleration": jnp.asarray(self.acceleration, dtype=float), "mass": mass_of(self, elements, 0, bodies)}

    def drawing(self, bodies):
        up = -np.asarray(self.acceleration, dtype=float)
        return {"up": up.tolist()} if up.ndim and up.any() else {}

    def check(self, bodies):
        super().check(bodies)
        shape = self.parameters(bodies)["acceleration"].shape
        for (name,) in self.elements(bodies):
            if shape not in ((), (bodies[name].size,)):
                raise ValueError(
                    f"{self.name}: acceleration has shape {shape}, {name} has dimension {bodies[name].size}; they must agree."
                )


def attraction(q, params):
    """``V = -G sum m_a m_b / sqrt(|q_a - q_b|^2 + s^2)``."""
    a, b = q
    distance = jnp.sqrt(jnp.sum((b - a) ** 2, axis=-1) + params["softening"] ** 2)
    return -params["constant"] * jnp.sum(params["mass_a"] * params["mass_b"] / distance)


@dataclass(frozen=True, eq=False)
class NBodyGravity(Effect):
    """Newton's gravity between bodies, ``V = -G sum_{a<b} m_a m_b / sqrt(|q_a - q_b|^2 + s^2)``.

    Args:
        constant: G, in the units of the scene.
        between: names of bodies, every pair of which attracts; or a list of pairs. All bodies by default.
        softening: s, a length; zero for points.
    """

    constant: Any = 6.674e-11
    between: Any = None
    softening: Any = 0.0

    kind = "potential"
    default_name = "nbody_gravity"
    numbers = ("mass_a", "mass_b", "softening")
    function = staticmethod(attraction)

    def elements(self, bodies):
        return all_pairs(self.between, bodies, self.name)

    def parameters(self, bodies):
        elements = self.elements(bodies)
        return {
            "constant": jnp.asarray(self.constant, dtype=float),
            "softening": jnp.asarray(self.softening, dtype=float),
            "mass_a": mass_of(self, elements, 0, bodies),
            "mass_b": mass_of(self, elements, 1, bodies),
        }

    def check(self, bodies):
        super().check(bodies)
        if not (is_concrete(self.softening) and np.all(np.asarray(self.softening) > 0)):
            require_apart(self, bodies)

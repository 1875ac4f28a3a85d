"""Bodies: points of a scene, or blocks of general coordinates."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from vmri_jax.mechanics.arrays import is_concrete, real_array

Pace = Literal["slow", "fast", "auto"]
LARGEST_POINT = 3
"""Coordinates of a point at most."""


@dataclass(frozen=True, eq=False)
class Body:
    """A point mass in one, two or three dimensions, or a block of n general coordinates with n masses.

    Its kinetic energy is ``sum_i m_i v_i^2 / 2``.

    Args:
        name: what effects call it.
        mass: kg, positive; one for all coordinates, or (n,) one for each.
        position: (n,) at the start, n = 1, 2, 3 for a point. A number is a vector of length one.
        velocity: (n,) at the start; at rest by default.
        pace: "slow" coordinates take macro steps, "fast" ones micro steps; "auto" lets the scene decide from
            estimates of frequencies.
        radius: how large it is drawn, in the unit of its position; by default as suits the picture. Of no effect on the
            motion: contacts have a radius of their own.
        block: its coordinates are general ones, not those of a point; more than three always are.

    Raises:
        TypeError: what is no real number.
        ValueError: an empty name, a mass or radius that is not positive, numbers that are not finite or of float32,
            shapes that do not match, another pace.
    """

    name: str
    mass: Any
    position: Any
    velocity: Any = None
    pace: Pace = "auto"
    radius: float | None = None
    block: bool = False

    def __post_init__(self):
        if not isinstance(self.name, str) or not self.name:
            raise ValueError(f"Body: name is {self.name!r}; it must be a string that is not empty.")
        if self.pace not in ("slow", "fast", "auto"):
            raise ValueError(f"Body {self.name}: pace is {self.pace!r}; it must be 'slow', 'fast' or 'auto'.")
        position = self._vector("position", self.position)
        velocity = np.zeros(position.shape) if self.velocity is None else self._vector("velocity", self.velocity)
        mass = self._numbers("mass", self.mass)
        if velocity.shape != position.shape:
            raise ValueError(
                f"Body {self.name}: velocity has shape {velocity.shape}, position has {position.shape}; they must be equal."
            )
        if mass.shape not in ((), position.shape):
            raise ValueError(
                f"Body {self.name}: mass has shape {mass.shape}; give one number, or one for each of {position.size} coordinates."
            )
        if is_concrete(mass) and not np.all(mass > 0):
            raise ValueError(f"Body {self.name}: mass is {mass}; every mass must be positive.")
        if self.radius is not None and is_concrete(self.radius) and not 0 < self.radius < np.inf:
            raise ValueError(f"Body {self.name}: radius is {self.radius!r}; it must be a positive number, or None.")
        block = self.block or position.size > LARGEST_POINT
        for name, value in (("position", position), ("velocity", velocity), ("mass", mass), ("block", block)):
            object.__setattr__(self, name, value)

    def _numbers(self, name: str, given):
        """Numbers as an array of float64, of NumPy where they are not traced: so the mode of JAX does not matter."""
        value = real_array(f"Body {self.name}: {name}", given)
        if not is_concrete(value):
            return value
        if not np.isfinite(value).all():
            raise ValueError(f"Body {self.name}: {name} is {np.asarray(value)}, which is not finite.")
        return np.asarray(value)

    def _vector(self, name: str, given):
        value = self._numbers(name, given)
        value = value[None] if value.ndim == 0 else value
        if value.ndim != 1 or not value.size:
            raise ValueError(f"Body {self.name}: {name} has shape {value.shape}; give a vector of coordinates, (n,).")
        return value

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return self.position.shape[0]


Bodies = Mapping[str, Body]
"""The bodies of a scene by name."""

"""Bodies: points of a scene, or blocks of general coordinates."""

from dataclasses import dataclass
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete, require_x64

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
        ValueError: an empty name, a mass or radius that is not positive, numbers that are not finite, shapes that do not
            match, another pace, 64-bit mode off.
    """

    name: str
    mass: Any
    position: Any
    velocity: Any = None
    pace: Pace = "auto"
    radius: float | None = None
    block: bool = False

    def __post_init__(self):
        require_x64()
        if not isinstance(self.name, str) or not self.name:
            raise ValueError(f"Body: name is {self.name!r}; it must be a string that is not empty.")
        if self.pace not in ("slow", "fast", "auto"):
            raise ValueError(f"Body {self.name}: pace is {self.pace!r}; it must be 'slow', 'fast' or 'auto'.")
        position = jnp.atleast_1d(jnp.asarray(self.position, dtype=float))
        if position.ndim != 1 or not position.size:
            raise ValueError(
                f"Body {self.name}: position has shape {position.shape}; give a vector of coordinates, (n,)."
            )
        velocity = jnp.zeros_like(position) if self.velocity is None else self.velocity
        velocity, mass = jnp.atleast_1d(jnp.asarray(velocity, dtype=float)), jnp.asarray(self.mass, dtype=float)
        if velocity.shape != position.shape:
            raise ValueError(
                f"Body {self.name}: velocity has shape {velocity.shape}, position has {position.shape}; they must be equal."
            )
        if mass.shape not in ((), position.shape):
            raise ValueError(
                f"Body {self.name}: mass has shape {mass.shape}; give one number, or one for each of {position.size} coordinates."
            )
        for name, value in (("position", position), ("velocity", velocity), ("mass", mass)):
            if is_concrete(value) and not np.isfinite(value).all():
                raise ValueError(f"Body {self.name}: {name} is {np.asarray(value)}, which is not finite.")
        if is_concrete(mass) and not np.all(np.asarray(mass) > 0):
            raise ValueError(f"Body {self.name}: mass is {np.asarray(mass)}; every mass must be positive.")
        if self.radius is not None and is_concrete(self.radius) and not 0 < self.radius < np.inf:
            raise ValueError(f"Body {self.name}: radius is {self.radius!r}; it must be a positive number, or None.")
        block = self.block or position.size > LARGEST_POINT
        for name, value in (("position", position), ("velocity", velocity), ("mass", mass), ("block", block)):
            object.__setattr__(self, name, value)

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return self.position.shape[0]

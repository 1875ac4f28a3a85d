"""Points whose motion is given: a spring to one, a rigid link to one, a body that is one."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete
from vmri_jax.scene.effect import Effect, groups
from vmri_jax.scene.effects.geometry import check_points, squeeze
from vmri_jax.scene.effects.links import START


@dataclass(frozen=True)
class _AlongPath:
    """A function of an effect with a path ``a(t)``; compared by value."""

    path: Callable

    def at(self, t, params):
        """The point."""
        return self.path(t, params["path"])


class PullTo(_AlongPath):
    """``F = k (a(t) - q)``, towards a moving point."""

    def __call__(self, t, q, v, params):
        (q,) = q
        return (params["stiffness"][..., None] * (self.at(t, params) - q),)


class RadiusDefect(_AlongPath):
    """``g = (|q - a(t)|^2 - l^2) / 2``."""

    def __call__(self, t, q, params):
        (q,) = q
        return (jnp.sum((q - self.at(t, params)) ** 2, axis=-1) - params["length"] ** 2) / 2


class Distance(_AlongPath):
    """``g = q - a(t)``."""

    def __call__(self, t, q, params):
        (q,) = q
        return q - self.at(t, params)


@dataclass(frozen=True, eq=False)
class _ToPath(Effect):
    """What effects between bodies and a moving point share.

    Args:
        bodies: a name, or a list of names.
        path: ``path(t, params) -> (d,)``, the point; define it at module level.
        params: what `path` gets as params.
    """

    bodies: Any
    path: Callable
    params: Any = field(default_factory=dict, kw_only=True)

    def elements(self, bodies):
        return groups(self.bodies, 1, self.name)

    def parameters(self, bodies):
        return {"path": self._of_path()}

    def _of_path(self):
        return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype=float), self.params)

    def away(self, bodies):
        """How far the bodies start, at t = 0, from the point, (n,), or () of a single body."""
        point = self.path(jnp.zeros(()), self._of_path())
        start = squeeze(jnp.stack([bodies[name].position for (name,) in self.elements(bodies)]))
        return jnp.sqrt(jnp.sum((start - point) ** 2, axis=-1))

    def check(self, bodies):
        if not callable(self.path):
            raise TypeError(f"{self.name}: path is {self.path!r}; give a function of (t, params).")
        check_points(self, bodies)
        shape = jax.eval_shape(lambda params: jnp.asarray(self.path(jnp.zeros(()), params)), self._of_path()).shape
        for (name,) in self.elements(bodies):
            needed = (bodies[name].size,)
            if shape != needed:
                raise ValueError(
                    f"{self.name}: path returns shape {shape}; {name} has dimension {needed[0]}, return {needed}."
                )
        super().check(bodies)


@dataclass(frozen=True, eq=False)
class MovingAnchor(_ToPath):
    """Springs to a moving point, ``F = k (a(t) - q)``: an elastic hold, and a force, because it does work.

    Args:
        bodies: a name, or a list of names.
        path: ``path(t, params) -> (d,)``, the point; define it at module level.
        stiffness: k, N/m, positive; one number, or one for each body.
        params: what `path` gets as params.

    Raises:
        ValueError: (of the scene) a stiffness that is not positive.
    """

    stiffness: Any

    kind = "force"
    default_name = "moving_anchors"
    numbers = ("stiffness",)

    @property
    def function(self):
        return PullTo(self.path)

    def parameters(self, bodies):
        return super().parameters(bodies) | {"stiffness": jnp.asarray(self.stiffness, dtype=float)}

    def check(self, bodies):
        super().check(bodies)
        self.require_positive(stiffness=self.stiffness)


@dataclass(frozen=True, eq=False)
class MovingPivot(_ToPath):
    """Rigid links to a moving point, ``g = (|q - a(t)|^2 - l^2) / 2 = 0``: a pendulum on a pivot that is moved.

    Args:
        bodies: a name, or a list of names.
        path: ``path(t, params) -> (d,)``, the point; define it at module level.
        length: l, positive; one number, or one for each. The distance at the start, t = 0, by default.
        params: what `path` gets as params.

    Raises:
        ValueError: (of the scene) bodies that start at the point, a length that is not positive or not the distance at the start.
    """

    length: Any = None

    kind = "constraint"
    timed = True
    default_name = "moving_pivots"
    numbers = ("length",)

    @property
    def function(self):
        return RadiusDefect(self.path)

    def parameters(self, bodies):
        length = self.away(bodies) if self.length is None else jnp.asarray(self.length, dtype=float)
        return super().parameters(bodies) | {"length": length}

    def check(self, bodies):
        super().check(bodies)
        length, start = self.parameters(bodies)["length"], self.away(bodies)
        what = "the distance of a body from its point"
        self.require(start > 0, what, start, "bodies must not start there; move one of them, or take Guide")
        self.require_positive(length=length)
        if is_concrete((length, start)):
            right = np.abs(length - start) <= START * np.asarray(length)
            self.require(right, "length", length, f"the bodies start {np.asarray(start)} from the point")


@dataclass(frozen=True, eq=False)
class Guide(_ToPath):
    """A body whose motion is given, ``g = q - a(t) = 0``; what holds it there does the work that is needed.

    Args:
        bodies: a name.
        path: ``path(t, params) -> (d,)``, where it is; define it at module level.
        params: what `path` gets as params.

    Raises:
        ValueError: (of the scene) a body that does not start there.
    """

    kind = "constraint"
    timed = True
    default_name = "guides"

    @property
    def function(self):
        return Distance(self.path)

    def check(self, bodies):
        super().check(bodies)
        away = self.away(bodies)
        size = jnp.max(jnp.abs(jnp.stack([bodies[name].position for (name,) in self.elements(bodies)])))
        what = "the distance of the body from its point at t = 0"
        self.require(away <= START * jnp.maximum(size, 1.0), what, away, "it must start there")

"""Points whose motion is given: a spring to one, a rigid link to one, a body that is one."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from vmri_jax.scene.declare import effect_class, positive
from vmri_jax.scene.effect import START, real_tree
from vmri_jax.scene.effects.bases import ToPoint
from vmri_jax.scene.effects.formulas import length_defect


@dataclass(frozen=True)
class AlongPath:
    """A formula with the point of a path, ``formula(a(t), q, ..., params)``, as a function of time; compared by value."""

    formula: Callable
    path: Callable

    def __call__(self, t, *arguments):
        return self.formula(self.path(t, arguments[-1]["path"]), *arguments)


@effect_class
class _ToPath(ToPoint):
    """What effects between bodies and a moving point share: ``formula(point, q, ..., params)`` at the point of the path."""

    path: Callable
    params: Any = field(default_factory=dict, kw_only=True)

    formula: ClassVar[Any]
    dimensions = (1, 2, 3)
    timed = True

    @property
    def function(self):
        return AlongPath(self.formula, self.path)

    def parameters(self, bodies):
        return super().parameters(bodies) | {"path": real_tree(f"{self.name}: params", self.params)}

    def point_at_start(self, params):
        return self.path(jnp.zeros(()), real_tree(f"{self.name}: params", self.params))

    def check_bodies(self, bodies):
        if not callable(self.path):
            raise TypeError(f"{self.name}: path is {self.path!r}; give a function of (t, params).")
        super().check_bodies(bodies)
        shape = jax.eval_shape(lambda: jnp.asarray(self.point_at_start({}))).shape
        for (name,) in self.elements(bodies):
            needed = (bodies[name].size,)
            if shape != needed:
                raise ValueError(
                    f"{self.name}: path returns shape {shape}; {name} has dimension {needed[0]}, return {needed}."
                )


@effect_class
class MovingAnchor(_ToPath):
    """Springs to a moving point, ``F = k (a(t) - q)``: an elastic hold, and a force, because it does work.

    Args:
        bodies: a name, or a list of names.
        path: ``path(t, params) -> (d,)``, the point; define it at module level.
        stiffness: k, N/m, positive; one number, or one for each body.
        params: what `path` gets as params.

    Raises:
        TypeError: (of the scene) a path that is no function.
        ValueError: (of the scene) a stiffness that is not positive.
    """

    stiffness: Any = positive()

    kind = "force"
    default_name = "moving_anchors"

    @staticmethod
    def formula(point, q, v, params):
        (q,) = q
        return (params["stiffness"][..., None] * (point - q),)


@effect_class
class MovingPivot(_ToPath):
    """Rigid links to a moving point, ``g = (|q - a(t)|^2 - l^2) / 2 = 0``: a pendulum on a pivot that is moved.

    Args:
        bodies: a name, or a list of names.
        path: ``path(t, params) -> (d,)``, the point; define it at module level.
        length: l, positive; one number, or one for each. The distance at the start, t = 0, by default.
        params: what `path` gets as params.

    Raises:
        TypeError: (of the scene) a path that is no function.
        ValueError: (of the scene) bodies that start at the point, a length that is not positive or not the distance at the start.
    """

    length: Any = positive(default=None, measured=True)

    kind = "constraint"
    default_name = "moving_pivots"

    @staticmethod
    def formula(point, q, params):
        (q,) = q
        return length_defect(q - point, params["length"])

    def check_parameters(self, bodies):
        self.require_away(bodies, "move one of them, or take Guide")
        super().check_parameters(bodies)


@effect_class
class Guide(_ToPath):
    """A body whose motion is given, ``g = q - a(t) = 0``; what holds it there does the work that is needed.

    Args:
        bodies: a name.
        path: ``path(t, params) -> (d,)``, where it is; define it at module level.
        params: what `path` gets as params.

    Raises:
        TypeError: (of the scene) a path that is no function.
        ValueError: (of the scene) a body that does not start there.
    """

    kind = "constraint"
    default_name = "guides"

    @staticmethod
    def formula(point, q, params):
        (q,) = q
        return q - point

    def check_parameters(self, bodies):
        super().check_parameters(bodies)
        away = self.at_start(bodies, self.parameters(bodies))
        size = jnp.max(jnp.abs(jnp.stack([bodies[name].position for (name,) in self.elements(bodies)])))
        what = "the distance of the body from its point at t = 0"
        self.require(away <= START * jnp.maximum(size, 1.0), what, away, "it must start there")

"""Base classes of effects between two points, or between a body and a point that is fixed or moves.

Each computes the vector x between both ends; ``law(x, params)`` of a derived class makes an energy, a constraint or a force of it.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import library
from vmri_jax.refusals import Refused
from vmri_jax.scene.body import end_of, label_of
from vmri_jax.scene.declare import names, of_time, real_tree, vector
from vmri_jax.scene.effect import Effect


def distance(q, params=None):
    """``|q_b - q_a|``, (...) m."""
    a, b = q
    return library(q).linalg.norm(b - a, axis=-1)


class BetweenPoints(Effect):
    """Between the two points of each pair, which do not start at the same place; ``x = q_b - q_a``."""

    between: Any = names(2)

    law: ClassVar[Any]
    dimensions = (1, 2, 3)
    apart = True
    rest = staticmethod(distance)

    @classmethod
    def function(cls, q, params):
        a, b = q
        return cls.law(b - a, params)


class ToPoint(Effect):
    """Between each body and a point p, which `point` or `path` of a derived class gives; ``x = q - p``."""

    bodies: Any = names()

    law: ClassVar[Any]
    advice: ClassVar[str] = "move one of them"
    """End of the message about bodies that start at the point."""

    def point_at_start(self, params):
        """The point p at t = 0."""
        return params["point"]

    def rest(self, q, params):
        """Distance of a body from the point at the start."""
        line = q[0] - self.point_at_start(params)
        return library(line).linalg.norm(line, axis=-1)

    def require_apart(self):
        """Refuse bodies that start at the point."""
        distance = self.at_start(self.parameters)
        expected = f"bodies must not start there; {self.advice}"
        self.require(distance > 0, "the distance of a body from its point", distance, expected)


class ToFixedPoint(ToPoint):
    """Between each body and a fixed point."""

    point: Any = vector()

    @classmethod
    def function(cls, q, params):
        (q,) = q
        return cls.law(q - params["point"], params)

    def __post_init__(self):
        super().__post_init__()
        if callable(self.point):
            raise Refused(
                f"{self.name}: point is {self.point!r}; {type(self).__name__} holds bodies at fixed points, give (d,) or (n, d). For a "
                "point that moves take MovingPivot (a rigid link), Guide (the point itself) or MovingAnchor (a spring)."
            )

    def drawing(self):
        points = np.atleast_2d(self.parameters["point"])
        anchors = []
        for (name,), point in zip(self.elements, points.tolist(), strict=True):
            if not end_of(self.by_name, name).block:
                anchors.append({"body": label_of(name), "point": point, "kind": self.drawn_as})
        return {"anchors": anchors}


class ToPath(ToPoint):
    """Between each body and a point that moves along a path; derived classes declare the `params` of the path as their last field."""

    path: Callable = of_time()

    dimensions = (1, 2, 3)
    timed = True

    @classmethod
    def function(cls, path, t, q, *arguments):
        (q,), params = q, arguments[-1]
        return cls.law(q - path(t, params["path"]), params)

    def point_at_start(self, params):
        return self.path(np.zeros(()), real_tree(f"{self.name}: params", vars(self)["params"]))

    def check_bodies(self):
        super().check_bodies()
        shape = jax.eval_shape(lambda: jnp.asarray(self.point_at_start({}))).shape
        for (name,) in self.elements:
            size = end_of(self.by_name, name).size
            if shape != (size,):
                raise Refused(
                    f"{self.name}: path returns shape {shape}; {name} has dimension {size}, return ({size},)."
                )

"""Anchors: points held at a distance of a fixed point, or by a spring to it."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from vmri_jax.scene.declare import effect_class, positive, vector
from vmri_jax.scene.effects.bases import ToPoint
from vmri_jax.scene.effects.formulas import elastic_energy, elongation, length_defect


@effect_class
class _ToFixedPoint(ToPoint):
    """What anchors to a fixed point share."""

    point: Any = vector()

    def __post_init__(self):
        super().__post_init__()
        if callable(self.point):
            raise TypeError(
                f"{self.name}: point is {self.point!r}; {type(self).__name__} holds bodies at fixed points, give (d,) or (n, d). For a "
                "point that moves take MovingPivot (a rigid link), Guide (the point itself) or MovingAnchor (a spring)."
            )

    def drawing(self, bodies):
        points = np.atleast_2d(np.asarray(self.parameters(bodies)["point"]))
        pairs = zip(self.elements(bodies), points, strict=True)
        drawn = [(name, point) for (name,), point in pairs if not bodies[name].block]
        return {"anchors": [{"body": name, "point": point.tolist(), "kind": self.drawn_as} for name, point in drawn]}


@effect_class
class Anchor(_ToFixedPoint):
    """Rigid links to fixed points, ``g = (|q - a|^2 - l^2) / 2 = 0``: a pendulum's rod.

    The points stay where they are; `MovingPivot` is a rigid link to a point that moves.

    Args:
        bodies: a name, or a list of names.
        point: a, (d,); or one for each body, (n, d).
        length: l, positive; one number, or one for each. The distance at the start by default.

    Raises:
        TypeError: a function as point.
        ValueError: (of the scene) bodies that start at the point, a length that is not positive or not the distance at the start.
    """

    length: Any = positive(default=None, measured=True)

    kind = "constraint"
    default_name = "anchors"
    dimensions = (1, 2, 3)
    drawn_as = "link"

    @staticmethod
    def function(q, params):
        (q,) = q
        return length_defect(q - params["point"], params["length"])

    def check_parameters(self, bodies):
        self.require_away(bodies)
        super().check_parameters(bodies)


@effect_class
class SpringAnchor(_ToFixedPoint):
    """Springs to fixed points, ``V = sum k/2 (|q - a| - l)^2``; without a length the well ``sum k/2 |q - a|^2``.

    Args:
        bodies: a name, or a list of names.
        point: a, (d,); or one for each body, (n, d).
        stiffness: k, N/m, positive; one number, or one for each.
        length: l, at rest, positive; likewise; None for a spring that pulls down to the point itself.

    Raises:
        TypeError: a function as point.
        ValueError: (of the scene) numbers that are not positive, bodies that start at the point of a spring with a length.
    """

    stiffness: Any = positive()
    length: Any = positive(default=None)

    kind = "potential"
    default_name = "spring_anchors"
    drawn_as = "spring"

    @staticmethod
    def function(q, params):
        (q,) = q
        if "length" not in params:
            return jnp.sum(params["stiffness"] / 2 * jnp.sum((q - params["point"]) ** 2, axis=-1))
        return elastic_energy(params["stiffness"], elongation(q - params["point"], params["length"]))

    def check_parameters(self, bodies):
        super().check_parameters(bodies)
        if self.length is not None:
            self.require_away(bodies)

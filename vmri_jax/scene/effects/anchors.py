"""Anchors: points held at a distance of a fixed point, or by a spring to it."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from vmri_jax.scene.declare import effect_class, names, positive, vector
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.effects.formulas import elastic_energy, elongation, length_defect


class ToPoint(Effect):
    """What effects between bodies and a point that is given share."""

    def point_at_start(self, params):
        """Where the point is at t = 0."""
        return params["point"]

    def rest(self, q, params):
        """Distance of a body from the point at the start."""
        (q,) = q
        return jnp.sqrt(jnp.sum((q - self.point_at_start(params)) ** 2, axis=-1))

    def require_away(self, bodies, advice: str = "move one of them"):
        """Refuse bodies that start at the point."""
        away = self.at_start(bodies, self.parameters(bodies))
        expected = f"bodies must not start there; {advice}"
        self.require(away > 0, "the distance of a body from its point", away, expected)


class _ToFixedPoint(ToPoint):
    """What anchors to a fixed point share."""

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


def rod(q, params):
    """``g = (|q - a|^2 - l^2) / 2``."""
    (q,) = q
    return length_defect(q - params["point"], params["length"])


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

    bodies: Any = names()
    point: Any = vector()
    length: Any = positive(default=None, measured=True)

    kind = "constraint"
    default_name = "anchors"
    dimensions = (1, 2, 3)
    drawn_as = "link"
    function = staticmethod(rod)

    def check_parameters(self, bodies):
        self.require_away(bodies)
        super().check_parameters(bodies)


def anchored_energy(q, params):
    """``V = sum k/2 (|q - a| - l)^2``; without a length ``sum k/2 |q - a|^2``."""
    (q,) = q
    if "length" not in params:
        return jnp.sum(params["stiffness"] / 2 * jnp.sum((q - params["point"]) ** 2, axis=-1))
    return elastic_energy(params["stiffness"], elongation(q - params["point"], params["length"]))


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

    bodies: Any = names()
    point: Any = vector()
    stiffness: Any = positive()
    length: Any = positive(default=None)

    kind = "potential"
    default_name = "spring_anchors"
    drawn_as = "spring"
    function = staticmethod(anchored_energy)

    def check_parameters(self, bodies):
        super().check_parameters(bodies)
        if self.length is not None:
            self.require_away(bodies)

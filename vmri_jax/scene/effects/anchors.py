"""Anchors: points held at a distance of a fixed point, or by a spring to it."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete
from vmri_jax.scene.effect import Effect, groups
from vmri_jax.scene.effects.geometry import check_points, squeeze, vector_of
from vmri_jax.scene.effects.links import START


def radius_defect(q, params):
    """``g = (|q - a|^2 - l^2) / 2``."""
    (q,) = q
    return (jnp.sum((q - params["point"]) ** 2, axis=-1) - params["length"] ** 2) / 2


def anchored_energy(q, params):
    """``V = sum k/2 (|q - a| - l)^2``; without a length ``sum k/2 |q - a|^2``."""
    (q,) = q
    if "length" not in params:
        return jnp.sum(params["stiffness"] / 2 * jnp.sum((q - params["point"]) ** 2, axis=-1))
    elongation = jnp.linalg.norm(q - params["point"], axis=-1) - params["length"]
    return jnp.sum(params["stiffness"] / 2 * elongation**2)


@dataclass(frozen=True, eq=False)
class _ToPoint(Effect):
    """What anchors to a fixed point share."""

    bodies: Any
    point: Any

    def __post_init__(self):
        super().__post_init__()
        if callable(self.point):
            raise TypeError(
                f"{self.name}: point is {self.point!r}; {type(self).__name__} holds bodies at fixed points, give (d,) or (n, d). For a "
                "point that moves take MovingPivot (a rigid link), Guide (the point itself) or MovingAnchor (a spring)."
            )

    def elements(self, bodies):
        return groups(self.bodies, 1, self.name)

    def distance(self, bodies):
        """Distance from the point at the start, (n,), or () of a single body."""
        point = vector_of(self, "point", self.point, bodies)
        start = squeeze(jnp.stack([bodies[name].position for (name,) in self.elements(bodies)]))
        return jnp.sqrt(jnp.sum((start - point) ** 2, axis=-1))

    def require_away(self, bodies):
        """Refuse bodies that start at the point."""
        away = self.distance(bodies)
        self.require(
            away > 0, "the distance of a body from its point", away, "bodies must not start there; move one of them"
        )

    def anchored(self, kind: str, bodies):
        """The drawing of links or springs to the points."""
        points = np.atleast_2d(np.asarray(vector_of(self, "point", self.point, bodies)))
        pairs = zip(self.elements(bodies), points, strict=True)
        drawn = [(name, point) for (name,), point in pairs if not bodies[name].block]
        return {"anchors": [{"body": name, "point": point.tolist(), "kind": kind} for name, point in drawn]}


@dataclass(frozen=True, eq=False)
class Anchor(_ToPoint):
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

    length: Any = None

    kind = "constraint"
    default_name = "anchors"
    numbers, vectors = ("length",), ("point",)
    function = staticmethod(radius_defect)

    def parameters(self, bodies):
        length = self.distance(bodies) if self.length is None else jnp.asarray(self.length, dtype=float)
        return {"point": vector_of(self, "point", self.point, bodies), "length": length}

    def check(self, bodies):
        super().check(bodies)
        check_points(self, bodies)
        self.require_away(bodies)
        length, start = self.parameters(bodies)["length"], self.distance(bodies)
        self.require_positive(length=length)
        if is_concrete((length, start)):
            right = np.abs(length - start) <= START * np.asarray(length)
            self.require(right, "length", length, f"the bodies start {np.asarray(start)} from their points")

    def drawing(self, bodies):
        return self.anchored("link", bodies)


@dataclass(frozen=True, eq=False)
class SpringAnchor(_ToPoint):
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

    stiffness: Any
    length: Any = None

    kind = "potential"
    default_name = "spring_anchors"
    numbers, vectors = ("stiffness", "length"), ("point",)
    function = staticmethod(anchored_energy)

    def parameters(self, bodies):
        given = {"stiffness": self.stiffness} | ({} if self.length is None else {"length": self.length})
        arrays = {name: jnp.asarray(value, dtype=float) for name, value in given.items()}
        return arrays | {"point": vector_of(self, "point", self.point, bodies)}

    def check(self, bodies):
        super().check(bodies)
        parameters = self.parameters(bodies)
        self.require_positive(**{name: parameters[name] for name in self.numbers if name in parameters})
        if self.length is not None:
            self.require_away(bodies)

    def drawing(self, bodies):
        return self.anchored("spring", bodies)

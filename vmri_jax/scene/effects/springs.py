"""Springs and rigid links between points, to fixed points and to moving points; bodies with a prescribed motion.

Each class computes the vector x between both ends; ``law(x, params)`` makes an energy, a constraint or a force of it.
"""

from collections.abc import Callable
from dataclasses import field
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import library
from vmri_jax.refusals import Refused
from vmri_jax.scene.body import end_of, label_of
from vmri_jax.scene.declare import array, names, of_time, positive, vector
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
        expected = f"bodies must not start there; move one of them{', or take Guide' if self.timed else ''}"
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
                f"{self.name}: point is {self.point!r}; {type(self).__name__} holds bodies at fixed points, give (d,) "
                "or (n, d). For a point that moves take MovingPivot (a rigid link), Guide (the point itself) or "
                "MovingAnchor (a spring)."
            )

    def drawing(self):
        points = np.atleast_2d(self.parameters["point"])
        anchors = []
        for (name,), point in zip(self.elements, points.tolist(), strict=True):
            if not end_of(self.by_name, name).block:
                anchors.append({"body": label_of(name), "point": point, "kind": self.drawn_as})
        return super().drawing() | {"anchors": anchors}


class ToPath(ToPoint):
    """Between each body and a point that moves along a path; derived classes declare the `params` of the path as their
    last field."""

    path: Callable = of_time()

    dimensions = (1, 2, 3)
    timed = True

    @classmethod
    def function(cls, path, t, q, *arguments):
        (q,), params = q, arguments[-1]
        return cls.law(q - path(t, params["path"]), params)

    def point_at_start(self, params):
        return self.path(np.zeros(()), params["path"])


def elastic_energy(stiffness, elongation):
    """``sum k/2 e^2`` of stiffnesses k and elongations e."""
    return jnp.sum(stiffness / 2 * elongation**2)


class Spring(BetweenPoints):
    """Linear springs, ``V = sum k/2 (|q_b - q_a| - l)^2``.

    Args:
        between: names of two bodies, or a list of such pairs.
        stiffness: k, N/m, positive; one number, or one for each spring.
        length: l, at rest, positive; likewise. The distance at the positions in `bodies` by default.
    """

    stiffness: Any = positive()
    length: Any = positive(default=None, measured=True)

    kind = "potential"
    drawn_as = "spring"
    default_name = "springs"

    @staticmethod
    def law(line, params):
        return elastic_energy(params["stiffness"], jnp.linalg.norm(line, axis=-1) - params["length"])


class NonlinearSpring(BetweenPoints):
    """Springs whose force is a polynomial of the elongation ``e = |q_b - q_a| - l``:
    ``k_1 e + k_2 e^2 + k_3 e^3 + ...``

    ``V = sum_j k_j e^(j+1) / (j+1)``; (k, 0, k_3) is a Duffing spring, stiffening for k_3 > 0.

    Args:
        between: names of two bodies, or a list of such pairs.
        coefficients: (k_1, k_2, ...), N/m^j, at least one, the same for all springs.
        length: l, at rest, positive; one number, or one for each spring. The distance at the positions in `bodies` by
            default.
    """

    coefficients: Any = array()
    length: Any = positive(default=None, measured=True)

    kind = "potential"
    drawn_as = "spring"
    default_name = "nonlinear_springs"

    @staticmethod
    def law(line, params):
        e, energy = jnp.linalg.norm(line, axis=-1) - params["length"], 0.0
        for j in range(params["coefficients"].shape[0], 0, -1):
            energy = (energy + params["coefficients"][j - 1] / (j + 1)) * e
        return jnp.sum(energy * e)

    def check_parameters(self):
        super().check_parameters()
        coefficients = self.parameters["coefficients"]
        is_vector = coefficients.ndim == 1 and coefficients.size > 0
        self.require(is_vector, "coefficients", repr(self.coefficients), "give (k_1, k_2, ...), at least one number")


class SpringAnchor(ToFixedPoint):
    """Springs to fixed points, ``V = sum k/2 (|q - a| - l)^2``; without a length the well ``sum k/2 |q - a|^2``.

    Args:
        bodies: a name, or a list of names.
        point: a, (d,); or one for each body, (n, d).
        stiffness: k, N/m, positive; one number, or one for each.
        length: l, at rest, positive; likewise; None for a spring that is relaxed at the point itself.
    """

    stiffness: Any = positive()
    length: Any = positive(default=None)

    kind = "potential"
    default_name = "spring_anchors"
    drawn_as = "spring"

    @staticmethod
    def law(line, params):
        if "length" in params:
            return Spring.law(line, params)
        return jnp.sum(params["stiffness"] / 2 * jnp.sum(line**2, axis=-1))

    @property
    def apart(self):
        return self.length is not None


class MovingAnchor(ToPath):
    """Springs to a moving point, ``F = k (a(t) - q)``: a force and not a potential, because it depends on time.

    Args:
        bodies: a name, or a list of names.
        path: ``path(t, params) -> (d,)``, the point.
        stiffness: k, N/m, positive; one number, or one for each body.
        params: of `path`.
    """

    stiffness: Any = positive()
    params: Any = field(default_factory=dict)

    kind = "force"
    default_name = "moving_anchors"

    @staticmethod
    def law(line, params):
        return (-params["stiffness"][..., None] * line,)


class _Rigid(Effect):
    """``g = (|x|^2 - l^2) / 2``, smooth also at x = 0."""

    length: Any = positive(default=None, measured=True)

    kind = "constraint"
    is_analytic = True
    apart = True
    dimensions = (1, 2, 3)

    @staticmethod
    def law(line, params):
        return ((line**2).sum(axis=-1) - params["length"] ** 2) / 2


class RigidLink(_Rigid, BetweenPoints):
    """Massless rigid links, ``g = (|q_b - q_a|^2 - l^2) / 2 = 0``.

    A link between slow bodies holds at the macro nodes, a link that touches a fast body at the micro nodes.

    Args:
        between: names of two bodies, or a list of such pairs.
        length: l, positive; one number, or one for each link. The distance at the positions in `bodies` by default, and
            no other one unless the scene projects.
    """

    default_name = "links"
    drawn_as = "link"


class Anchor(_Rigid, ToFixedPoint):
    """Rigid links to fixed points, ``g = (|q - a|^2 - l^2) / 2 = 0``: a pendulum's rod.

    The points stay where they are; `MovingPivot` is a rigid link to a point that moves.

    Args:
        bodies: a name, or a list of names.
        point: a, (d,); or one for each body, (n, d).
        length: l, positive, as of `RigidLink`.
    """

    default_name = "anchors"
    drawn_as = "link"


class MovingPivot(_Rigid, ToPath):
    """Rigid links to a moving point, ``g = (|q - a(t)|^2 - l^2) / 2 = 0``: a pendulum on a pivot that is moved.

    Args:
        bodies: a name, or a list of names.
        path: ``path(t, params) -> (d,)``, the point.
        length: l, positive, as of `RigidLink`; the distance at t = 0.
        params: of `path`.
    """

    params: Any = field(default_factory=dict)

    default_name = "moving_pivots"


class Guide(ToPath):
    """A body with a prescribed motion, ``g = q - a(t) = 0``. Minus the multiplier is the force (N) that moves the body
    along a(t); it does work.

    Args:
        bodies: a name.
        path: a, ``path(t, params) -> (d,)``, which starts at the body.
        params: of `path`.
    """

    params: Any = field(default_factory=dict)

    kind = "constraint"
    is_analytic = True
    default_name = "guides"

    @staticmethod
    def law(line, params):
        return line

"""Rigid links between points, to fixed points and to moving points; bodies with a prescribed motion."""

from typing import Any

from vmri_jax.mechanics.arrays import library
from vmri_jax.scene.declare import effect_class, positive
from vmri_jax.scene.effect import START, Effect
from vmri_jax.scene.effects.points import BetweenPoints, ToFixedPoint, ToPath


@effect_class
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


@effect_class
class RigidLink(_Rigid, BetweenPoints):
    """Massless rigid links, ``g = (|q_b - q_a|^2 - l^2) / 2 = 0``.

    A link between slow bodies holds at the macro nodes, a link that touches a fast body at the micro nodes.

    Args:
        between: names of two bodies, or a list of such pairs.
        length: l, positive; one number, or one for each link. The distance at the positions in `bodies` by default, and no other one unless
            the scene projects.
    """

    default_name = "links"
    drawn_as = "link"


@effect_class
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


@effect_class
class MovingPivot(_Rigid, ToPath):
    """Rigid links to a moving point, ``g = (|q - a(t)|^2 - l^2) / 2 = 0``: a pendulum on a pivot that is moved.

    Args:
        bodies: a name, or a list of names.
        path: ``path(t, params) -> (d,)``, the point.
        length: l, positive, as of `RigidLink`; the distance at t = 0.
        params: of `path`.
    """

    default_name = "moving_pivots"
    advice = "move one of them, or take Guide"


@effect_class
class Guide(ToPath):
    """A body with a prescribed motion, ``g = q - a(t) = 0``. Minus the multiplier is the force (N) that moves the body along a(t); it does work.

    Args:
        bodies: a name.
        path: a, ``path(t, params) -> (d,)``, which starts at the body.
        params: of `path`.
    """

    kind = "constraint"
    is_analytic = True
    default_name = "guides"

    @staticmethod
    def law(line, params):
        return line

    def check_start(self):
        super().check_start()
        distance = self.at_start(self.parameters)
        (positions,) = self.positions(range(len(self.elements)))
        size = abs(positions).max()
        quantity = "the distance of the body from its point at t = 0"
        self.require(distance <= START * library(size).maximum(size, 1.0), quantity, distance, "it must start there")

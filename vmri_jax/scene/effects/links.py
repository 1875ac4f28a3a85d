"""Rigid links between points."""

from typing import Any

from vmri_jax.scene.declare import effect_class, positive
from vmri_jax.scene.effects.bases import BetweenPoints
from vmri_jax.scene.effects.formulas import length_defect


@effect_class
class RigidLink(BetweenPoints):
    """Massless rigid links, ``g = (|q_b - q_a|^2 - l^2) / 2 = 0``.

    A link between slow bodies is held at the macro nodes, one that touches a fast body at the micro nodes.

    Args:
        between: names of two bodies, or a list of such pairs.
        length: l, positive; one number, or one for each link. The distance at the start by default.

    Raises:
        ValueError: (of the scene) ends at one point at the start, a length that is not positive or not the distance at
            the start, links that together are redundant.
    """

    length: Any = positive(default=None, measured=True)

    kind = "constraint"
    default_name = "links"
    drawn_as = "link"

    @staticmethod
    def function(q, params):
        a, b = q
        return length_defect(b - a, params["length"])

"""Rigid links between points."""

from typing import Any

from vmri_jax.scene.declare import effect_class, names, positive
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.effects.formulas import distance, length_defect


def link(q, params):
    """``g = (|q_b - q_a|^2 - l^2) / 2``."""
    a, b = q
    return length_defect(b - a, params["length"])


@effect_class
class RigidLink(Effect):
    """Massless rigid links, ``g = (|q_b - q_a|^2 - l^2) / 2 = 0``.

    A link between slow bodies is held at the macro nodes, one that touches a fast body at the micro nodes.

    Args:
        between: names of two bodies, or a list of such pairs.
        length: l, positive; one number, or one for each link. The distance at the start by default.

    Raises:
        ValueError: (of the scene) ends at one point at the start, a length that is not positive or not the distance at
            the start, links that together are redundant.
    """

    between: Any = names(2)
    length: Any = positive(default=None, measured=True)

    kind = "constraint"
    default_name = "links"
    dimensions = (1, 2, 3)
    apart = True
    drawn_as = "link"
    function = staticmethod(link)
    rest = staticmethod(distance)

"""Rigid links between points."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete
from vmri_jax.scene.effect import Effect, groups
from vmri_jax.scene.effects.geometry import check_points, distances, length_of, require_apart

START = 1e-9
"""How far, relative to its length, a link may be from its length at the start."""


def length_defect(q, params):
    """``g = (|q_b - q_a|^2 - l^2) / 2``."""
    a, b = q
    return (jnp.sum((b - a) ** 2, axis=-1) - params["length"] ** 2) / 2


@dataclass(frozen=True, eq=False)
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

    between: Any
    length: Any = None

    kind = "constraint"
    default_name = "links"
    numbers = ("length",)
    function = staticmethod(length_defect)

    def elements(self, bodies):
        return groups(self.between, 2, self.name)

    def parameters(self, bodies):
        return {"length": length_of(self, self.length, bodies)}

    def check(self, bodies):
        super().check(bodies)
        check_points(self, bodies)
        require_apart(self, bodies)
        length, elements = self.parameters(bodies)["length"], self.elements(bodies)
        self.require_positive(length=length)
        start = distances(elements, bodies)
        if is_concrete((length, start)):
            found = zip(elements, *np.broadcast_arrays(*map(np.atleast_1d, (length, start))), strict=True)
            for (a, b), given, apart in found:
                right = abs(given - apart) <= START * given
                self.require(right, f"the link {a}-{b}", f"{given:g} long", f"{a} and {b} start {apart:.12g} apart")

    def drawing(self, bodies):
        return {"links": [list(element) for element in self.elements(bodies)]}

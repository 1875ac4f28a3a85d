"""What effects between two points, and between a body and a given point, share."""

from typing import Any

import jax.numpy as jnp

from vmri_jax.scene.declare import effect_class, names
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.effects.formulas import distance


@effect_class
class BetweenPoints(Effect):
    """Between the two points of each pair, which do not start at the same place."""

    between: Any = names(2)

    dimensions = (1, 2, 3)
    apart = True
    rest = staticmethod(distance)


@effect_class
class ToPoint(Effect):
    """Between each body and a point that is given."""

    bodies: Any = names()

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

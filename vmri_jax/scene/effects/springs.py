"""Springs between points: linear, and with a polynomial law."""

from typing import Any

import jax.numpy as jnp

from vmri_jax.scene.declare import array, effect_class, positive
from vmri_jax.scene.effects.bases import BetweenPoints
from vmri_jax.scene.effects.formulas import elastic_energy, elongation


@effect_class
class Spring(BetweenPoints):
    """Linear springs, ``V = sum k/2 (|q_b - q_a| - l)^2``.

    Args:
        between: names of two bodies, or a list of such pairs.
        stiffness: k, N/m, positive; one number, or one for each spring.
        length: l, at rest, positive; likewise. The distance at the start by default.

    Raises:
        ValueError: (of the scene) numbers that are not positive, ends at one point at the start.
    """

    stiffness: Any = positive()
    length: Any = positive(default=None, measured=True)

    kind = "potential"
    drawn_as = "spring"
    default_name = "springs"

    @staticmethod
    def function(q, params):
        a, b = q
        return elastic_energy(params["stiffness"], elongation(b - a, params["length"]))


@effect_class
class NonlinearSpring(BetweenPoints):
    """Springs whose force is a polynomial of the elongation ``e = |q_b - q_a| - l``: ``k_1 e + k_2 e^2 + k_3 e^3 + ...``

    ``V = sum_j k_j e^(j+1) / (j+1)``; (k, 0, k_3) is a Duffing spring, stiffening for k_3 > 0.

    Args:
        between: names of two bodies, or a list of such pairs.
        coefficients: (k_1, k_2, ...), N/m^j, the same for all springs.
        length: l, at rest, positive; one number, or one for each spring. The distance at the start by default.

    Raises:
        ValueError: (of the scene) no coefficients, a length that is not positive, ends at one point at the start.
    """

    coefficients: Any = array()
    length: Any = positive(default=None, measured=True)

    kind = "potential"
    drawn_as = "spring"
    default_name = "nonlinear_springs"

    @staticmethod
    def function(q, params):
        a, b = q
        e, energy = elongation(b - a, params["length"]), 0.0
        for j in range(params["coefficients"].shape[0], 0, -1):
            energy = (energy + params["coefficients"][j - 1] / (j + 1)) * e
        return jnp.sum(energy * e)

    def check_parameters(self, bodies):
        super().check_parameters(bodies)
        coefficients = self.parameters(bodies)["coefficients"]
        if coefficients.ndim != 1 or not coefficients.size:
            raise ValueError(
                f"{self.name}: coefficients is {self.coefficients!r}; give (k_1, k_2, ...), at least one number."
            )

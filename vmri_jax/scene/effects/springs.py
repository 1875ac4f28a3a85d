"""Springs between points: linear, and with a polynomial law."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

from vmri_jax.scene.effect import Effect, groups
from vmri_jax.scene.effects.geometry import check_points, length_of, require_apart


def elongation(q, params):
    """``e = |q_b - q_a| - l``."""
    a, b = q
    return jnp.linalg.norm(b - a, axis=-1) - params["length"]


def elastic_energy(q, params):
    """``V = sum k/2 e^2``."""
    return jnp.sum(params["stiffness"] / 2 * elongation(q, params) ** 2)


@dataclass(frozen=True, eq=False)
class Spring(Effect):
    """Linear springs, ``V = sum k/2 (|q_b - q_a| - l)^2``.

    Args:
        between: names of two bodies, or a list of such pairs.
        stiffness: k, N/m, positive; one number, or one for each spring.
        length: l, at rest, positive; likewise. The distance at the start by default.

    Raises:
        ValueError: (of the scene) numbers that are not positive, ends at one point at the start.
    """

    between: Any
    stiffness: Any
    length: Any = None

    kind = "potential"
    default_name = "springs"
    numbers = ("stiffness", "length")
    function = staticmethod(elastic_energy)

    def elements(self, bodies):
        return groups(self.between, 2, self.name)

    def parameters(self, bodies):
        return {"stiffness": jnp.asarray(self.stiffness, dtype=float), "length": length_of(self, self.length, bodies)}

    def check(self, bodies):
        super().check(bodies)
        check_points(self, bodies)
        require_apart(self, bodies)
        self.require_positive(**self.parameters(bodies))

    def drawing(self, bodies):
        return {"springs": [list(element) for element in self.elements(bodies)]}


def polynomial_energy(q, params):
    """``V = sum_j k_j e^(j+1) / (j+1)``."""
    e, energy = elongation(q, params), 0.0
    for j in range(params["coefficients"].shape[0], 0, -1):
        energy = (energy + params["coefficients"][j - 1] / (j + 1)) * e
    return jnp.sum(energy * e)


@dataclass(frozen=True, eq=False)
class NonlinearSpring(Effect):
    """Springs whose force is a polynomial of the elongation ``e = |q_b - q_a| - l``: ``k_1 e + k_2 e^2 + k_3 e^3 + ...``

    ``V = sum_j k_j e^(j+1) / (j+1)``; (k, 0, k_3) is a Duffing spring, stiffening for k_3 > 0.

    Args:
        between: names of two bodies, or a list of such pairs.
        coefficients: (k_1, k_2, ...), N/m^j, the same for all springs.
        length: l, at rest, positive; one number, or one for each spring. The distance at the start by default.

    Raises:
        ValueError: (of the scene) no coefficients, a length that is not positive, ends at one point at the start.
    """

    between: Any
    coefficients: Any
    length: Any = None

    kind = "potential"
    default_name = "nonlinear_springs"
    numbers = ("length",)
    function = staticmethod(polynomial_energy)

    def elements(self, bodies):
        return groups(self.between, 2, self.name)

    def parameters(self, bodies):
        coefficients = jnp.asarray(self.coefficients, dtype=float)
        return {"coefficients": coefficients, "length": length_of(self, self.length, bodies)}

    def check(self, bodies):
        super().check(bodies)
        coefficients = self.parameters(bodies)["coefficients"]
        if coefficients.ndim != 1 or not coefficients.size:
            raise ValueError(
                f"{self.name}: coefficients is {self.coefficients!r}; give (k_1, k_2, ...), at least one number."
            )
        check_points(self, bodies)
        require_apart(self, bodies)
        self.require_positive(length=self.parameters(bodies)["length"])

    def drawing(self, bodies):
        return {"springs": [list(element) for element in self.elements(bodies)]}

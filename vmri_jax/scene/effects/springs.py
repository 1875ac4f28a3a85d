"""Springs between points, to fixed points and to moving points."""

from typing import Any

import jax.numpy as jnp

from vmri_jax.scene.declare import array, effect_class, positive
from vmri_jax.scene.effects.points import BetweenPoints, ToFixedPoint, ToPath


def elastic_energy(stiffness, elongation):
    """``sum k/2 e^2`` of stiffnesses k and elongations e."""
    return jnp.sum(stiffness / 2 * elongation**2)


@effect_class
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


@effect_class
class NonlinearSpring(BetweenPoints):
    """Springs whose force is a polynomial of the elongation ``e = |q_b - q_a| - l``: ``k_1 e + k_2 e^2 + k_3 e^3 + ...``

    ``V = sum_j k_j e^(j+1) / (j+1)``; (k, 0, k_3) is a Duffing spring, stiffening for k_3 > 0.

    Args:
        between: names of two bodies, or a list of such pairs.
        coefficients: (k_1, k_2, ...), N/m^j, at least one, the same for all springs.
        length: l, at rest, positive; one number, or one for each spring. The distance at the positions in `bodies` by default.
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


@effect_class
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


@effect_class
class MovingAnchor(ToPath):
    """Springs to a moving point, ``F = k (a(t) - q)``: a force and not a potential, because it depends on time.

    Args:
        bodies: a name, or a list of names.
        path: ``path(t, params) -> (d,)``, the point.
        stiffness: k, N/m, positive; one number, or one for each body.
        params: of `path`.
    """

    stiffness: Any = positive()

    kind = "force"
    default_name = "moving_anchors"

    @staticmethod
    def law(line, params):
        return (-params["stiffness"][..., None] * line,)

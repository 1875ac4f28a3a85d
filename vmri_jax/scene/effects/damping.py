"""Forces against motion: linear damping, dashpots between points, quadratic drag."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

from vmri_jax.scene.effect import Effect, each, groups
from vmri_jax.scene.effects.geometry import check_points, norm, require_apart


@dataclass(frozen=True, eq=False)
class _Resistance(Effect):
    """What forces against the motion of single bodies share."""

    coefficient: Any
    bodies: Any = None

    kind = "force"
    numbers = ("coefficient",)

    def elements(self, bodies):
        return each(self.bodies, bodies, self.name)

    def parameters(self, bodies):
        return {"coefficient": jnp.asarray(self.coefficient, dtype=float)}

    def check(self, bodies):
        super().check(bodies)
        self.require_positive(coefficient=self.coefficient)


def linear_damping(t, q, v, params):
    """``F = -c v``."""
    (v,) = v
    return (-params["coefficient"][..., None] * v,)


class LinearDamping(_Resistance):
    """Damping of bodies against the ground, ``F = -c v``.

    Args:
        coefficient: c, N s/m, positive; one number, or one for each body.
        bodies: names; all bodies of the scene by default.

    Raises:
        ValueError: (of the scene) a coefficient that is not positive.
    """

    default_name = "damping"
    function = staticmethod(linear_damping)


def quadratic_drag(t, q, v, params):
    """``F = -c |v| v``."""
    (v,) = v
    return (-(params["coefficient"] * norm(v))[..., None] * v,)


class QuadraticDrag(_Resistance):
    """Drag of a resting fluid, ``F = -c |v| v``.

    Args:
        coefficient: c, kg/m, positive, half of density, drag coefficient and area; one number, or one for each body.
        bodies: names; all bodies of the scene by default.

    Raises:
        ValueError: (of the scene) a coefficient that is not positive.
    """

    default_name = "drag"
    function = staticmethod(quadratic_drag)


def dashpot(t, q, v, params):
    """``F_b = -c ((v_b - v_a) . n) n = -F_a``, n the direction from a to b."""
    (a, b), (v_a, v_b) = q, v
    along = b - a
    rate = jnp.sum((v_b - v_a) * along, axis=-1) / jnp.sum(along**2, axis=-1)
    force = -(params["coefficient"] * rate)[..., None] * along
    return -force, force


@dataclass(frozen=True, eq=False)
class Dashpot(Effect):
    """Dampers between points, against the change of their distance: ``F_b = -c ((v_b - v_a) . n) n = -F_a``.

    Args:
        between: names of two bodies, or a list of such pairs.
        coefficient: c, N s/m, positive; one number, or one for each.

    Raises:
        ValueError: (of the scene) a coefficient that is not positive, ends at one point at the start.
    """

    between: Any
    coefficient: Any

    kind = "force"
    default_name = "dashpots"
    numbers = ("coefficient",)
    function = staticmethod(dashpot)

    def elements(self, bodies):
        return groups(self.between, 2, self.name)

    def parameters(self, bodies):
        return {"coefficient": jnp.asarray(self.coefficient, dtype=float)}

    def check(self, bodies):
        super().check(bodies)
        check_points(self, bodies)
        require_apart(self, bodies)
        self.require_positive(coefficient=self.coefficient)

"""Forces against motion: linear damping, quadratic drag, dashpots between points, Rayleigh damping."""

from dataclasses import replace
from typing import Any

import jax.numpy as jnp

from vmri_jax.mechanics.names import unknown
from vmri_jax.refusals import Refused
from vmri_jax.scene.declare import array, names, positive
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.effects.points import BetweenPoints
from vmri_jax.scene.terms import TangentDamping, joined


def norm(v):
    """``|v|``, with derivative zero at v = 0."""
    square = jnp.sum(v**2, axis=-1)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


class LinearDamping(Effect):
    """Damping of points and of the centres of rigid bodies against the ground, ``F = -c v``; rotations are not damped.

    Args:
        coefficient: c, N s/m, positive; one number, or one for each body.
        bodies: names; all bodies of the scene by default.
    """

    coefficient: Any = positive()
    bodies: Any = names(default=None)

    kind = "force"
    default_name = "damping"

    @staticmethod
    def function(t, q, v, params):
        (v,) = v
        return (-params["coefficient"][..., None] * v,)


class QuadraticDrag(Effect):
    """Drag of a resting fluid, ``F = -c |v| v``.

    Args:
        coefficient: c, kg/m, positive: density times drag coefficient times area, over 2; one number, or one for each body.
        bodies: names; all bodies of the scene by default.
    """

    coefficient: Any = positive()
    bodies: Any = names(default=None)

    kind = "force"
    default_name = "drag"

    @staticmethod
    def function(t, q, v, params):
        (v,) = v
        return (-(params["coefficient"] * norm(v))[..., None] * v,)


class Dashpot(BetweenPoints):
    """Dampers between points, against the change of their distance: ``F_b = -c ((v_b - v_a) . n) n = -F_a``, n from a to b.

    Args:
        between: names of two bodies, or a list of such pairs.
        coefficient: c, N s/m, positive; one number, or one for each.
    """

    coefficient: Any = positive()

    kind = "force"
    default_name = "dashpots"

    @staticmethod
    def function(t, q, v, params):
        (a, b), (v_a, v_b) = q, v
        along = b - a
        rate = jnp.sum((v_b - v_a) * along, axis=-1) / jnp.sum(along**2, axis=-1)
        force = -(params["coefficient"] * rate)[..., None] * along
        return -force, force


class RayleighDamping(Effect):
    """Rayleigh damping of the whole scene, ``F = -(alpha M + beta K(q)) v``, K the Hessian of potentials.

    M has the masses of points and of the centres of rigid bodies: alpha does not damp rotations.

    The damping ratio of a vibration of frequency w is ``alpha / (2 w) + beta w / 2``. K is the Hessian at the present configuration; along
    directions of negative curvature the force adds energy.

    Args:
        mass: alpha, 1/s, positive; None for zero.
        stiffness: beta, s, positive; None for zero if there is a mass.
        of: names of the potentials in K; all potentials of the scene by default.
    """

    mass: Any = array(default=None, sign="positive")
    stiffness: Any = array(default=None, sign="positive")
    of: Any = None

    kind = "force"
    default_name = "rayleigh_damping"

    @staticmethod
    def function(t, q, v, params):
        (v,) = v
        return (-(params["mass"] * params["mass_of"])[..., None] * v,)

    @property
    def masses(self):
        return () if self.mass is None else ("mass_of",)

    def resolved(self, effects):
        """The effect with its potentials in a tuple instead of their names."""
        potentials = {effect.name: effect for effect in effects if effect.kind == "potential"}
        names = potentials if self.of is None else [self.of] if isinstance(self.of, str) else self.of
        for name in names:
            if name not in potentials:
                raise Refused(f"{self.name}: {unknown('potential', name, potentials)}")
        # a potential in a joint has the joint itself, too, before its terms are asked for
        return replace(self, of=tuple(potentials[name].resolved(effects).bound(self.by_name) for name in names))

    def _elements(self):
        return tuple((name,) for name in self.by_name)

    def check_parameters(self):
        if self.mass is None and self.stiffness is None:
            raise Refused(f"{self.name}: mass and stiffness are both None; give at least one of them.")
        super().check_parameters()

    def terms(self, select, layout):
        terms = () if self.mass is None else super().terms(select, layout)
        damped = [term for potential in self.of for term in potential.terms(range(len(potential.elements)), layout)]
        return terms if self.stiffness is None or not damped else (*terms, TangentDamping(joined(damped), self.name))

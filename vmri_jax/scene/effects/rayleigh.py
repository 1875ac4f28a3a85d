"""Rayleigh damping, proportional to the masses and to the stiffness of potentials."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

from vmri_jax.scene.effect import Effect, each
from vmri_jax.scene.effects.geometry import mass_of
from vmri_jax.scene.terms import TangentDamping


def mass_damping(t, q, v, params):
    """``F = -alpha m v``."""
    (v,) = v
    return (-(params["mass"] * params["mass_of"])[..., None] * v,)


@dataclass(frozen=True, eq=False)
class RayleighDamping(Effect):
    """Rayleigh damping of the whole scene, ``F = -(alpha M + beta K(q)) v``, K the Hessian of potentials.

    A vibration of frequency w is damped by the ratio ``alpha / (2 w) + beta w / 2``. K is taken at the present
    configuration; where a potential has negative curvature this part gives energy instead.

    Args:
        mass: alpha, 1/s, positive; None for none.
        stiffness: beta, s, positive; None for none.
        of: names of the potentials whose stiffness damps; all of the scene by default.

    Raises:
        ValueError: (of the scene) neither alpha nor beta, numbers that are not positive, a name in `of` that is no potential.
    """

    mass: Any = None
    stiffness: Any = None
    of: Any = None

    kind = "force"
    default_name = "rayleigh_damping"
    numbers = ("mass_of",)
    function = staticmethod(mass_damping)

    def elements(self, bodies):
        return each(None, bodies, self.name)

    @property
    def refers_to(self):
        return () if self.of is None else (self.of,) if isinstance(self.of, str) else tuple(self.of)

    def parameters(self, bodies):
        given = {"mass": self.mass, "stiffness": self.stiffness}
        parameters = {name: jnp.asarray(value, dtype=float) for name, value in given.items() if value is not None}
        return (
            parameters
            if self.mass is None
            else parameters | {"mass_of": mass_of(self, self.elements(bodies), 0, bodies)}
        )

    def check(self, bodies):
        if self.mass is None and self.stiffness is None:
            raise ValueError(f"{self.name}: mass and stiffness are both None; give at least one of them.")
        super().check(bodies)
        self.require_positive(**{name: value for name, value in self.parameters(bodies).items() if name != "mass_of"})

    def terms(self, select, bodies, places, potentials):
        terms = () if self.mass is None else super().terms(select, bodies, places, potentials)
        names = [name for name in potentials if self.of is None or name in self.refers_to]
        damped = tuple(term for name in names for term in potentials[name])
        return terms if self.stiffness is None or not damped else (*terms, TangentDamping(self.name, damped))

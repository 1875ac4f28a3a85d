"""The functions of a `System` as sums of terms.

All classes here are compared by value: scenes of the same structure give equal functions, which JAX compiles only once.
"""

from dataclasses import dataclass
from itertools import chain
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.kinematics import JOINTS, MASS, Kinematics
from vmri_jax.mechanics.rows import Entries
from vmri_jax.scene.terms import concatenated, total, totals

IMPLIED = "implied"
"""Key of params that holds the sizes of the dropped rows."""
RESERVED = {
    MASS: "the masses",
    IMPLIED: "the sizes of rows that are left out",
    JOINTS: "the points and axes of joints that carry bodies",
}
"""Keys of params that no effect may have as its name, and their content, for messages."""


@dataclass(frozen=True)
class _OfTerms:
    """A function of a `System`, made of terms of the coordinates Q of bodies; compared by class, terms and kinematics.

    The kinematics are the map from the coordinates q of the scene to Q; None if Q = q. Of the rows of a constraint `rows` are taken; None for all.
    """

    terms: tuple[Any, ...]
    kinematics: Kinematics | None = None
    rows: Entries | None = None

    def values(self, q_s, q_f, params, *t):
        """The values of the rows of constraints, one term after the other."""
        bodies = self.bodies(q_s, q_f, params)
        values = concatenated([term.value(*bodies, params, *t) for term in self.terms])
        return values if self.rows is None else self.rows.take(values)

    def bodies(self, q_s, q_f, params) -> tuple[Any, Any]:
        """(Q_s, Q_f) of q_s and q_f; one of these may be None if the terms do not depend on it, and zeros take its place."""
        if self.kinematics is None:
            return q_s, q_f
        slow, fast = (jnp.zeros(n) if q is None else q for q, n in zip((q_s, q_f), self.kinematics.sizes, strict=True))
        return self.kinematics(slow, fast, params[JOINTS])

    def motions(self, q_s, q_f, v_s, v_f, params):
        """Coordinates (Q_s, Q_f) of the bodies, and their velocities (V_s, V_f), ``V = dQ/dq v``; Q = q without joint coordinates."""
        if self.kinematics is None:
            return (q_s, q_f), (v_s, v_f)
        return jax.jvp(lambda q_s, q_f: self.bodies(q_s, q_f, params), (q_s, q_f), (v_s, v_f))

    def forces_on(self, q_s, q_f, params, forces):
        """Generalised forces on (q_s, q_f) of forces F on the coordinates of bodies: ``(dQ/dq)^T F``."""
        if self.kinematics is None:
            return forces
        return jax.vjp(lambda q_s, q_f: self.bodies(q_s, q_f, params), q_s, q_f)[1](forces)


class SlowPotential(_OfTerms):
    """``V(q_s, q_f, params)``, the sum of its terms."""

    def __call__(self, q_s, q_f, params):
        bodies = self.bodies(q_s, q_f, params)
        return total([term.value(*bodies, params) for term in self.terms])


class FastPotential(_OfTerms):
    """``W(q_f, params)``, the sum of its terms."""

    def __call__(self, q_f, params):
        bodies = self.bodies(None, q_f, params)
        return total([term.value(*bodies, params) for term in self.terms])


class MicroConstraint(_OfTerms):
    """``g(q_s, q_f, params)``, or ``g(t, q_s, q_f, params)``: the values of its terms one after the other."""

    def __call__(self, *arguments):
        *t, q_s, q_f, params = arguments
        return self.values(q_s, q_f, params, *t)


class MacroConstraint(_OfTerms):
    """``g_s(q_s, params)``, or ``g_s(t, q_s, params)``: the values of its terms one after the other."""

    def __call__(self, *arguments):
        *t, q_s, params = arguments
        return self.values(q_s, None, params, *t)


class ImpliedRows(MicroConstraint):
    """``g_i(q_s, q_f, params)``, or ``g_i(t, q_s, q_f, params)``: the values of the dropped rows over their sizes."""

    def __call__(self, *arguments):
        return super().__call__(*arguments) / arguments[-1][IMPLIED]


class KineticEnergy(_OfTerms):
    """``T = sum m V_f^2 / 2`` of the velocities V_f of bodies that depend on fast coordinates, plus the velocity-dependent terms."""

    def __call__(self, q_s, q_f, v_s, v_f, params):
        bodies, rates = self.motions(q_s, q_f, v_s, v_f, params)
        of_bodies = jnp.sum(params[MASS]["fast"] * rates[1] ** 2) / 2
        return total([of_bodies, *(term.kinetic(*bodies, *rates, params) for term in self.terms)])


class SlowKineticEnergy(_OfTerms):
    """``T_s = sum m V_s^2 / 2`` of the velocities V_s of bodies that depend on slow coordinates alone."""

    def __call__(self, q_s, v_s, params):
        none = jnp.zeros(0 if self.kinematics is None else self.kinematics.sizes[1])
        (rates, _) = self.motions(q_s, none, v_s, none, params)[1]
        return jnp.sum(params[MASS]["slow"] * rates**2) / 2


class TotalForce(_OfTerms):
    """``F(t, q_s, q_f, v_s, v_f, params)``, the sum of its terms."""

    def __call__(self, t, q_s, q_f, v_s, v_f, params):
        bodies, rates = self.motions(q_s, q_f, v_s, v_f, params)
        forces = totals([term.forces(t, *bodies, *rates, params) for term in self.terms])
        return self.forces_on(q_s, q_f, params, forces)


@dataclass(frozen=True)
class Actuation(_OfTerms):
    """Forces of controls, ``(q_s, q_f, u, params) -> (F_s, F_f)``; each effect has a term and names of its controls."""

    names: tuple[tuple[str, ...], ...] = ()

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of all controls, in the order of u."""
        return tuple(chain(*self.names))

    def __call__(self, q_s, q_f, u, params):
        ends, bodies = np.cumsum([len(names) for names in self.names])[:-1], self.bodies(q_s, q_f, params)
        controls = zip(self.terms, jnp.split(u, ends), strict=True)
        forces = totals([term.controlled(*bodies, u_effect, params) for term, u_effect in controls])
        return self.forces_on(q_s, q_f, params, forces)


FUNCTIONS = {
    "kinetic": KineticEnergy,
    "slow_kinetic": SlowKineticEnergy,
    "slow_potential": SlowPotential,
    "fast_potential": FastPotential,
    "constraint": MicroConstraint,
    "slow_constraint": MacroConstraint,
    "force": TotalForce,
    "implied": ImpliedRows,
}
"""For each argument of `System`, the class that makes a function of its terms."""

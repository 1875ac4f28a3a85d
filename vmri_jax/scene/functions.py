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
from vmri_jax.mechanics.masses import WithMassMatrix
from vmri_jax.mechanics.rows import Entries
from vmri_jax.mechanics.slots import Computed
from vmri_jax.mechanics.terms import KINDS
from vmri_jax.scene.terms import total, totals

IMPLIED = Computed("implied")
"""Key of params that holds the sizes of the dropped rows."""
RESERVED = {
    MASS: "the masses",
    IMPLIED: "the sizes of rows that are left out",
    JOINTS: "the points and axes of joints that carry bodies",
}
"""Keys of params that no effect may have as its name, and their content, for messages."""


@dataclass(frozen=True)
class _OfTerms:
    """A function of a `System`, made of terms of the coordinates Q of bodies; compared by class and fields.

    field: the argument of `System`, see `vmri_jax.mechanics.terms.KINDS`.
    kinematics: the map from the coordinates q of the scene to Q; None if Q = q.
    rows: of a constraint, those that are taken; None for all.
    """

    field: str
    terms: tuple[Any, ...]
    kinematics: Kinematics | None = None
    rows: Entries | None = None

    def by_name(self, arguments) -> tuple[Any, ...]:
        """(t, q_s, q_f, v_s, v_f, params) of the arguments of a call, with None for those that the function does not take."""
        *arguments, params = arguments
        names = ("t", *KINDS[self.field].arguments)[-len(arguments) :]  # rows that depend on time get t first
        values = dict(zip(names, arguments, strict=True))
        return *map(values.get, ("t", "q_s", "q_f", "v_s", "v_f")), params

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


class PotentialEnergy(_OfTerms):
    """V, W or V_i, the sum of its terms."""

    def __call__(self, *arguments):
        _, q_s, q_f, *_, params = self.by_name(arguments)
        bodies = self.bodies(q_s, q_f, params)
        return total([term.value(*bodies, params) for term in self.terms])


class ConstraintValues(_OfTerms):
    """g or g_s, the values of its terms one after the other; g_i, the values of the dropped rows over their sizes."""

    def __call__(self, *arguments):
        t, q_s, q_f, *_, params = self.by_name(arguments)
        bodies = self.bodies(q_s, q_f, params)
        values = jnp.concatenate([jnp.ravel(term.value(*bodies, params, t)) for term in self.terms])
        values = values if self.rows is None else self.rows.take(values)
        return values / params[IMPLIED] if self.field == "implied" else values


class KineticEnergy(_OfTerms, WithMassMatrix):
    """``T = sum m V_f^2 / 2`` of bodies that depend on fast coordinates, plus the velocity-dependent terms; ``T_s = sum m V_s^2 / 2`` of all others."""

    def __call__(self, *arguments):
        _, q_s, q_f, v_s, v_f, params = self.by_name(arguments)
        part, number = ("slow", 0) if self.field == "slow_kinetic" else ("fast", 1)
        if q_f is None:
            q_f = v_f = jnp.zeros(0 if self.kinematics is None else self.kinematics.sizes[1])
        bodies, rates = self.motions(q_s, q_f, v_s, v_f, params)
        of_bodies = jnp.sum(params[MASS][part] * rates[number] ** 2) / 2
        return total([of_bodies, *(term.kinetic(*bodies, *rates, params) for term in self.terms)])

    @property
    def has_mass_matrix(self) -> bool:
        return self.kinematics is not None and not self.terms

    def mass_matrix(self, q_s, q_f, params):
        assert self.kinematics is not None
        if q_f is not None:
            return self.kinematics.mass_matrix(q_s, q_f, params[JOINTS], jnp.asarray(params[MASS]["fast"]), "f")
        n_s, n_f = self.kinematics.sizes
        masses = jnp.asarray(params[MASS]["slow"])
        return self.kinematics.mass_matrix(q_s, jnp.zeros(n_f), params[JOINTS], masses, "s")[:n_s, :n_s]


class TotalForce(_OfTerms):
    """F, the sum of its terms."""

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


FUNCTIONS: dict[str, Any] = {
    "kinetic": KineticEnergy,
    "potential": PotentialEnergy,
    "constraint": ConstraintValues,
    "implied": ConstraintValues,
    "force": TotalForce,
}
"""For each kind of a function of `System`, the class that makes it of its terms."""

"""Terms: effects at their places in q_s and q_f, and the functions of a `System` as sums of terms.

Everything here is compared by value: scenes of the same structure give equal functions, and nothing is compiled twice.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import chain, pairwise
from operator import add
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.kinematics import JOINTS, MASS, Kinematics
from vmri_jax.mechanics.rows import Rows
from vmri_jax.scene.body import GROUND_COORDINATES

IMPLIED = "implied"
"""Where the sizes of rows that are left out are in params."""
RESERVED = {
    MASS: "the masses",
    IMPLIED: "the sizes of rows that are left out",
    JOINTS: "the points and axes of joints that carry bodies",
}
"""Names in params that no effect may have, and what stands there."""


@dataclass(frozen=True)
class OnBodies:
    """A role whose bodies are points, blocks, rigid bodies as a whole or their centres: it gets their coordinates.

    Args:
        rows: where these are.
    """

    rows: Rows

    def positions(self, q_s, q_f, params):
        """(d,) or (n, d) coordinates."""
        return self.rows.take(q_s, q_f)

    def velocities(self, v_s, v_f, params):
        """Their rates."""
        return self.rows.take(v_s, v_f)

    def put(self, force, params, n_s: int, n_f: int):
        """Forces on all slow and on all fast coordinates."""
        return self.rows.put(force, n_s, n_f)


@dataclass(frozen=True)
class InRigidBodies:
    """A role whose points are fixed in rigid bodies: ``phi + sum_i X_i d_i`` with the components X in params.

    Args:
        rows: where the coordinates of the bodies are.
        at: name of the parameter X.
    """

    rows: Rows
    at: str

    def positions(self, q_s, q_f, params):
        """(3,) or (n, 3) points."""
        q, at = self.rows.take(q_s, q_f), params[self.at]
        triples = q.reshape(*q.shape[:-1], -1, 3)
        arms = at[..., : triples.shape[-2] - 1, None] * triples[..., 1:, :]
        return triples[..., 0, :] + jnp.sum(arms, axis=-2)

    def velocities(self, v_s, v_f, params):
        """Their velocities: the same map, which is linear."""
        return self.positions(v_s, v_f, params)

    def put(self, force, params, n_s: int, n_f: int):
        """Forces on all slow and on all fast coordinates."""
        at = params[self.at][..., : self.rows.stride // 3 - 1, None]
        force = jnp.broadcast_to(force, (*jnp.broadcast_shapes(force.shape[:-1], at.shape[:-2]), 3))
        triples = jnp.concatenate([force[..., None, :], at * force[..., None, :]], axis=-2)
        return self.rows.put(triples.reshape(*triples.shape[:-2], -1), n_s, n_f)


@dataclass(frozen=True)
class OnGround:
    """A role that stays where it is: points given in params, or the ground as a rigid body whose axes are those of space.

    Args:
        count: of elements.
        size: of a point; 12 for the ground as a whole.
        at: name of the parameter with the points; None for the ground as a whole.
    """

    count: int
    size: int
    at: str | None = None

    def positions(self, q_s, q_f, params):
        """(d,) or (n, d) points."""
        if self.at is not None:
            return params[self.at][..., : self.size]
        return self._shaped(jnp.asarray(GROUND_COORDINATES))

    def velocities(self, v_s, v_f, params):
        """Zero."""
        return self._shaped(jnp.zeros(self.size))

    def put(self, force, params, n_s: int, n_f: int):
        """Nothing: what holds the ground is not part of the scene."""
        return jnp.zeros(n_s), jnp.zeros(n_f)

    def _shaped(self, vector):
        return vector if self.count == 1 else jnp.broadcast_to(vector, (self.count, self.size))


Role = OnBodies | InRigidBodies | OnGround


@dataclass(frozen=True)
class EffectTerm:
    """The function of an effect on the elements `select` (None: all of them), whose roles lie at `roles`.

    `split` names the parameters that have an entry for each element. The function of a `timed` one has the time before its
    other arguments.
    """

    name: str
    function: Callable
    roles: tuple[Role, ...]
    select: tuple[int, ...] | None = None
    split: tuple[str, ...] = ()
    timed: bool = False

    def params_of(self, params):
        """What the function gets as params."""
        return params[self.name] if self.select is None else choose(params[self.name], self.select, self.split)

    def value(self, q_s, q_f, params, t=None):
        """Energy or constraint values."""
        own = self.params_of(params)
        return self.function(*((t,) if self.timed else ()), self._positions(q_s, q_f, own), own)

    def kinetic(self, q_s, q_f, v_s, v_f, params):
        """Velocity-dependent energy."""
        own = self.params_of(params)
        return self.function(self._positions(q_s, q_f, own), self._velocities(v_s, v_f, own), own)

    def forces(self, t, q_s, q_f, v_s, v_f, params):
        """Force on all slow and on all fast coordinates."""
        own, sizes = self.params_of(params), (q_s.shape[0], q_f.shape[0])
        forces = self.function(t, self._positions(q_s, q_f, own), self._velocities(v_s, v_f, own), own)
        return totals([role.put(force, own, *sizes) for role, force in zip(self.roles, forces, strict=True)])

    def controlled(self, q_s, q_f, u, params):
        """Force on all slow and on all fast coordinates of controls u."""
        own, sizes = self.params_of(params), (q_s.shape[0], q_f.shape[0])
        forces = self.function(self._positions(q_s, q_f, own), u, own)
        return totals([role.put(force, own, *sizes) for role, force in zip(self.roles, forces, strict=True)])

    def within(self, sizes: tuple[int, int]) -> bool:
        """Whether it takes nothing but the coordinates of the scene, the first (n_s, n_f) of Q."""
        return all(isinstance(role, OnGround) or role.rows.within(sizes) for role in self.roles)

    def _positions(self, q_s, q_f, params):
        return tuple(role.positions(q_s, q_f, params) for role in self.roles)

    def _velocities(self, v_s, v_f, params):
        return tuple(role.velocities(v_s, v_f, params) for role in self.roles)


@dataclass(frozen=True)
class SomeRows:
    """The values of some terms of a constraint one after the other, without those that are `dropped`."""

    terms: tuple[EffectTerm, ...]
    dropped: tuple[int, ...]

    @property
    def timed(self) -> bool:
        """Whether one of them depends on time."""
        return any(term.timed for term in self.terms)

    def within(self, sizes: tuple[int, int]) -> bool:
        """As of `EffectTerm`."""
        return all(term.within(sizes) for term in self.terms)

    def value(self, q_s, q_f, params, t=None):
        """The values that stay, by static slices."""
        values = joined([term.value(q_s, q_f, params, t) for term in self.terms])
        ends = [-1, *self.dropped, values.shape[0]]
        return joined([values[low + 1 : high] for low, high in pairwise(ends)])


@dataclass(frozen=True)
class DroppedRows(SomeRows):
    """The values that `SomeRows` leaves out."""

    def value(self, q_s, q_f, params, t=None):
        """These values, by static slices."""
        values = joined([term.value(q_s, q_f, params, t) for term in self.terms])
        return joined([values[k : k + 1] for k in self.dropped])


@dataclass(frozen=True)
class TangentDamping:
    """``F = -beta K v``, K the Hessian of the energy of some terms."""

    name: str
    terms: tuple[EffectTerm, ...]

    def within(self, sizes: tuple[int, int]) -> bool:
        """As of `EffectTerm`."""
        return all(term.within(sizes) for term in self.terms)

    def forces(self, t, q_s, q_f, v_s, v_f, params):
        """Force on all slow and on all fast coordinates."""

        def energy(q):
            q_s, q_f = q
            return total([term.value(q_s, q_f, params) for term in self.terms])

        rates = jax.jvp(jax.grad(energy), ((q_s, q_f),), ((v_s, v_f),))[1]
        return tuple(-params[self.name]["stiffness"] * rate for rate in rates)


def choose(params, select: Sequence[int], split: Sequence[str]):
    """Parameters of some elements: entries of those in `split` that have one for each element."""
    return params | {name: pick(params[name], select) for name in split if name in params and jnp.ndim(params[name])}


def pick(values, select: Sequence[int]):
    """Entries of an array by static slices; a single one without its axis."""
    if len(select) == 1:
        return values[select[0]]
    if list(select) == list(range(select[0], select[0] + len(select))):
        return values[select[0] : select[0] + len(select)]
    return jnp.stack([values[i] for i in select])


def total(values: Sequence):
    """Sum of one or more arrays."""
    return reduce(add, values)


def totals(pairs: Sequence):
    """Sums of the first and of the second ones of pairs (slow, fast)."""
    return tuple(total(parts) for parts in zip(*pairs, strict=True))


def joined(values: Sequence):
    """One vector of arrays of any shape."""
    return jnp.concatenate([jnp.ravel(value) for value in values])


@dataclass(frozen=True)
class _OfTerms:
    """A function of a `System` that is made of terms; compared by class, terms and kinematics.

    Args:
        terms: functions of the coordinates of bodies Q.
        kinematics: from the coordinates of the scene q to Q; None where they are the same.
    """

    terms: tuple[Any, ...]
    kinematics: Kinematics | None = None

    def bodies(self, q_s, q_f, params) -> tuple[Any, Any]:
        """(Q_s, Q_f) of q_s and q_f, one of which may be None: the terms do not depend on it, zeros are as good."""
        if self.kinematics is None:
            return q_s, q_f
        slow, fast = (jnp.zeros(n) if q is None else q for q, n in zip((q_s, q_f), self.kinematics.sizes, strict=True))
        return self.kinematics(slow, fast, params[JOINTS])

    def motions(self, q_s, q_f, v_s, v_f, params):
        """(Q_s, Q_f) and their rates."""
        if self.kinematics is None:
            return (q_s, q_f), (v_s, v_f)
        return jax.jvp(lambda q_s, q_f: self.bodies(q_s, q_f, params), (q_s, q_f), (v_s, v_f))

    def forces_on(self, q_s, q_f, params, forces):
        """(F_s, F_f) of forces on the coordinates of bodies: ``(dQ/dq)^T F``."""
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
        bodies = self.bodies(q_s, q_f, params)
        return joined([term.value(*bodies, params, *t) for term in self.terms])


class MacroConstraint(_OfTerms):
    """``g_s(q_s, params)``, or ``g_s(t, q_s, params)``: the values of its terms one after the other."""

    def __call__(self, *arguments):
        *t, q_s, params = arguments
        bodies = self.bodies(q_s, None, params)
        return joined([term.value(*bodies, params, *t) for term in self.terms])


class ImpliedRows(MicroConstraint):
    """``g_i(q_s, q_f, params)``, or ``g_i(t, q_s, q_f, params)``: the values of rows that are left out, in parts of their sizes."""

    def __call__(self, *arguments):
        return super().__call__(*arguments) / arguments[-1][IMPLIED]


class KineticEnergy(_OfTerms):
    """``T = sum m V_f^2 / 2`` of the rates V_f of bodies that depend on fast coordinates, and the velocity-dependent terms."""

    def __call__(self, q_s, q_f, v_s, v_f, params):
        bodies, rates = self.motions(q_s, q_f, v_s, v_f, params)
        of_bodies = jnp.sum(params[MASS]["fast"] * rates[1] ** 2) / 2
        return total([of_bodies, *(term.kinetic(*bodies, *rates, params) for term in self.terms)])


class SlowKineticEnergy(_OfTerms):
    """``T_s = sum m V_s^2 / 2`` of the rates V_s of bodies that depend on slow coordinates alone."""

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
    """Forces of the controls of a scene, ``(q_s, q_f, u, params) -> (F_s, F_f)``, see `vmri_jax.control.minimize`.

    Args:
        terms: one of each effect.
        names: of the controls of each effect.
    """

    names: tuple[tuple[str, ...], ...] = ()

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of all controls, in the order of u."""
        return tuple(chain(*self.names))

    def __call__(self, q_s, q_f, u, params):
        ends, bodies = np.cumsum([len(names) for names in self.names])[:-1], self.bodies(q_s, q_f, params)
        controls = zip(self.terms, jnp.split(u, ends), strict=True)
        forces = totals([term.controlled(*bodies, own, params) for term, own in controls])
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
"""What is made of the terms of a home."""

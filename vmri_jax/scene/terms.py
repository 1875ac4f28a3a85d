"""Terms: effects as functions of the coordinates of bodies, of which `vmri_jax.scene.functions` makes the functions of a `System`.

All classes here are compared by value: scenes of the same structure give equal functions, which JAX compiles only once.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import pairwise
from operator import add
from typing import Any

import jax
import jax.numpy as jnp

from vmri_jax.mechanics.rows import Rows
from vmri_jax.scene.body import GROUND_COORDINATES


@dataclass(frozen=True)
class Applied:
    """A function with its first arguments filled in; compared by value, which `functools.partial` is not."""

    function: Callable
    arguments: tuple[Any, ...]

    def __call__(self, *arguments):
        return self.function(*self.arguments, *arguments)


def split(q):
    """Centre (..., 3) and directors (..., k, 3), a director per row, of the coordinates q (..., 3 + 3 k) of a rigid body."""
    triples = q.reshape(*q.shape[:-1], -1, 3)
    return triples[..., 0, :], triples[..., 1:, :]


def place(q, weights):
    """``phi + sum_i X_i d_i``, (..., 3), of the coordinates q of a body, which may have fewer than three directors, and the components X of a point."""
    phi, d = split(q)
    return phi + jnp.sum(weights[..., : d.shape[-2], None] * d, axis=-2)


@dataclass(frozen=True)
class OnBodies:
    """A role whose bodies are points, blocks, whole rigid bodies or their centres: it takes their coordinates."""

    rows: Rows

    def positions(self, q_s, q_f, params):
        """(d,) or (n, d) coordinates."""
        return self.rows.take(q_s, q_f)

    velocities = positions

    def put(self, force, params, n_s: int, n_f: int):
        """Forces on all slow and on all fast coordinates."""
        return self.rows.put(force, n_s, n_f)


@dataclass(frozen=True)
class InRigidBodies:
    """A role of points fixed in rigid bodies, ``phi + sum_i X_i d_i`` with X, a `parameter` in params."""

    rows: Rows
    parameter: str

    def positions(self, q_s, q_f, params):
        """(3,) or (n, 3) points."""
        return place(self.rows.take(q_s, q_f), params[self.parameter])

    velocities = positions  # the map is linear

    def put(self, force, params, n_s: int, n_f: int):
        """Forces on all slow and on all fast coordinates."""
        # the transpose of the map of positions: F on the centre, X_i F on the director d_i
        components = params[self.parameter][..., : self.rows.stride // 3 - 1, None]
        force = jnp.broadcast_to(force, (*jnp.broadcast_shapes(force.shape[:-1], components.shape[:-2]), 3))
        triples = jnp.concatenate([force[..., None, :], components * force[..., None, :]], axis=-2)
        return self.rows.put(triples.reshape(*triples.shape[:-2], -1), n_s, n_f)


@dataclass(frozen=True)
class OnGround:
    """A role that does not move: for `count` elements points of `size` coordinates, a `parameter` in params.

    Without a parameter it is the ground as a rigid body with the axes of space, and the size is 12.
    """

    count: int
    size: int
    parameter: str | None = None

    def positions(self, q_s, q_f, params):
        """(d,) or (n, d) points."""
        if self.parameter is not None:
            return params[self.parameter][..., : self.size]
        return self._shaped(jnp.asarray(GROUND_COORDINATES))

    def velocities(self, v_s, v_f, params):
        """Zero."""
        return self._shaped(jnp.zeros(self.size))

    def put(self, force, params, n_s: int, n_f: int):
        """Zero: no coordinate of the scene feels a force on the ground."""
        return jnp.zeros(n_s), jnp.zeros(n_f)

    def _shaped(self, vector):
        return vector if self.count == 1 else jnp.broadcast_to(vector, (self.count, self.size))


Role = OnBodies | InRigidBodies | OnGround


@dataclass(frozen=True)
class EffectTerm:
    """The function of an effect, whose name is the key of its parameters, on some of its elements.

    roles: the maps from q_s and q_f to the coordinates of each role.
    select: indices of the elements; None for all.
    split: names of the parameters that have an entry for each element.
    timed: whether the first argument of the function is the time.
    """

    name: str
    function: Callable
    roles: tuple[Role, ...]
    select: tuple[int, ...] | None = None
    split: tuple[str, ...] = ()
    timed: bool = False

    def params_of(self, params):
        """The params of the function: the parameters of the effect, for the selected elements."""
        return params[self.name] if self.select is None else choose(params[self.name], self.select, self.split)

    def value(self, q_s, q_f, params, t=None):
        """Energy or constraint values."""
        params = self.params_of(params)
        return self.function(*((t,) if self.timed else ()), self._positions(q_s, q_f, params), params)

    def kinetic(self, q_s, q_f, v_s, v_f, params):
        """Velocity-dependent energy."""
        params = self.params_of(params)
        return self.function(self._positions(q_s, q_f, params), self._velocities(v_s, v_f, params), params)

    def forces(self, t, q_s, q_f, v_s, v_f, params):
        """Force on all slow and on all fast coordinates."""
        params = self.params_of(params)
        forces = self.function(t, self._positions(q_s, q_f, params), self._velocities(v_s, v_f, params), params)
        return self._put(forces, params, q_s.shape[0], q_f.shape[0])

    def controlled(self, q_s, q_f, u, params):
        """Force of the controls u on all slow and on all fast coordinates."""
        params = self.params_of(params)
        forces = self.function(self._positions(q_s, q_f, params), u, params)
        return self._put(forces, params, q_s.shape[0], q_f.shape[0])

    def within(self, sizes: tuple[int, int]) -> bool:
        """Whether the term depends only on the coordinates of the scene, the first n_s of Q_s and the first n_f of Q_f."""
        return all(isinstance(role, OnGround) or role.rows.within(sizes) for role in self.roles)

    def _put(self, forces, params, n_s: int, n_f: int):
        return totals([role.put(force, params, n_s, n_f) for role, force in zip(self.roles, forces, strict=True)])

    def _positions(self, q_s, q_f, params):
        return tuple(role.positions(q_s, q_f, params) for role in self.roles)

    def _velocities(self, v_s, v_f, params):
        return tuple(role.velocities(v_s, v_f, params) for role in self.roles)


@dataclass(frozen=True)
class _OfSeveral:
    """A term that is made of terms."""

    terms: tuple[EffectTerm, ...]

    @property
    def timed(self) -> bool:
        """Whether a term depends on time."""
        return any(term.timed for term in self.terms)

    def within(self, sizes: tuple[int, int]) -> bool:
        """Whether all terms depend only on the coordinates of the scene, see `EffectTerm.within`."""
        return all(term.within(sizes) for term in self.terms)


@dataclass(frozen=True)
class SomeRows(_OfSeveral):
    """The values of some terms of a constraint one after the other, without the rows `dropped`, or these rows `alone`."""

    dropped: tuple[int, ...]
    alone: bool = False

    def value(self, q_s, q_f, params, t=None):
        """The values of the rows, by static slices."""
        values = concatenated([term.value(q_s, q_f, params, t) for term in self.terms])
        if self.alone:
            return concatenated([values[k : k + 1] for k in self.dropped])
        ends = [-1, *self.dropped, values.shape[0]]
        return concatenated([values[low + 1 : high] for low, high in pairwise(ends)])


@dataclass(frozen=True)
class TangentDamping(_OfSeveral):
    """``F = -beta K v`` with the Hessian K of the energy of some terms; beta is the parameter "stiffness"."""

    name: str

    def forces(self, t, q_s, q_f, v_s, v_f, params):
        """Force on all slow and on all fast coordinates."""

        def energy(q):
            q_s, q_f = q
            return total([term.value(q_s, q_f, params) for term in self.terms])

        # K v as the derivative of the gradient along v, without the matrix K
        products = jax.jvp(jax.grad(energy), ((q_s, q_f),), ((v_s, v_f),))[1]
        return tuple(-params[self.name]["stiffness"] * product for product in products)


def choose(params, select: Sequence[int], split: Sequence[str]):
    """The parameters of some elements; parameters in `split` may have an entry for each element."""
    return params | {name: pick(params[name], select) for name in split if name in params and jnp.ndim(params[name])}


def pick(values, select: Sequence[int]):
    """Entries of an array by static slices; a single entry without its axis."""
    if len(select) == 1:
        return values[select[0]]
    if list(select) == list(range(select[0], select[0] + len(select))):
        return values[select[0] : select[0] + len(select)]
    return jnp.stack([values[i] for i in select])


def total(values: Sequence):
    """Sum of one or more arrays."""
    return reduce(add, values)


def totals(pairs: Sequence):
    """Sum of pairs (slow, fast): the pair of the sums."""
    return tuple(total(parts) for parts in zip(*pairs, strict=True))


def concatenated(values: Sequence):
    """One vector of arrays of any shape."""
    return jnp.concatenate([jnp.ravel(value) for value in values])

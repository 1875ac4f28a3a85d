"""Terms: effects as functions of the coordinates of bodies, of which `vmri_jax.scene.functions` makes the functions of a `System`.

All classes here are compared by value: scenes of the same structure give equal functions, which JAX compiles only once.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import chain, groupby
from operator import add
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import library
from vmri_jax.mechanics.kinematics import UNMOVED
from vmri_jax.mechanics.rows import Place, Rows


@dataclass(frozen=True)
class Applied:
    """A function with its first arguments filled in; compared by value, which `functools.partial` is not."""

    function: Callable
    arguments: tuple[Any, ...]

    def __call__(self, *arguments):
        return self.function(*self.arguments, *arguments)


def is_of_package(function: Callable) -> bool:
    """Whether a function, with all functions that are filled in, is part of this package: these act element by element on any number of elements.

    A function of the user may be right for a single element alone, such as ``sum(q**2)**2``.
    """
    if isinstance(function, Applied):
        return all(is_of_package(part) for part in (function.function, *function.arguments) if callable(part))
    return str(getattr(function, "__module__", "")).startswith(f"{__name__.partition('.')[0]}.")


def split(q):
    """Centre (..., 3) and directors (..., k, 3), a director per row, of the coordinates q (..., 3 + 3 k) of a rigid body."""
    triples = q.reshape(*q.shape[:-1], -1, 3)
    return triples[..., 0, :], triples[..., 1:, :]


def place(q, weights):
    """``phi + sum_i X_i d_i``, (..., 3), of the coordinates q of a body, which may have fewer than three directors, and the components X of a point."""
    phi, d = split(q)
    return phi + (weights[..., : d.shape[-2], None] * d).sum(axis=-2)


@dataclass(frozen=True)
class Role:
    """The map from q_s and q_f to the coordinates of the bodies, or to points in them, that elements have in one role: linear but on the ground.

    rows: coordinates of the bodies, all of one kind; None for the ground.
    count, size: number of elements, and of coordinates that the function takes of each.
    point: name of the parameter with the components X of points ``phi + sum_i X_i d_i`` fixed in rigid bodies or, on the ground, of
        points in space; "" for bodies themselves. The ground itself is a rigid body with the axes of space.
    """

    rows: Rows | None
    count: int
    size: int
    point: str = ""

    @property
    def pieces(self) -> "tuple[Role, ...]":
        """The role itself, see `Roles`."""
        return (self,)

    def positions(self, q_s, q_f, params) -> Any:
        """(d,) or (n, d) coordinates or points."""
        return self.of_bodies(None if self.rows is None else self.rows.take(q_s, q_f), params)

    def of_bodies(self, q, params):
        """Coordinates or points, from the coordinates of the bodies, which the ground does not need."""
        if self.rows is not None:
            return place(q, params[self.point]) if self.point else q
        if self.point:
            return params[self.point][..., : self.size]
        ground = UNMOVED.ravel()  # the ground as a rigid body
        return ground if self.count == 1 else np.broadcast_to(ground, (self.count, self.size))


@dataclass(frozen=True)
class Roles:
    """Roles of bodies of several kinds as one role: the elements of the first one, then of the second one, and so on."""

    pieces: tuple[Role, ...]

    @classmethod
    def joined(cls, roles: "Iterable[Role | Roles]") -> "Role | Roles":
        """One role of the elements of roles of one size, one after the other."""
        pieces: list[Any] = [*chain(*(role.pieces for role in roles))]
        of_kinds = []
        for (stride, _), (*same,) in groupby(pieces, key=lambda role: (role.rows and role.rows.stride, role.point)):
            rows = Rows.of([*chain(*(role.rows.places for role in same))], same[0].rows.size) if stride else None
            of_kinds.append(replace(same[0], rows=rows, count=sum(role.count for role in same)))
        return of_kinds[0] if len(of_kinds) == 1 else cls(tuple(of_kinds))

    @property
    def size(self) -> int:
        """As of each of the roles."""
        return self.pieces[0].size

    def positions(self, q_s, q_f, params):
        """(n, d) coordinates or points."""
        of_pieces, end = [], 0
        for role in self.pieces:
            first, end = end, end + role.count
            points = {role.point: pick(params[role.point], range(first, end))} if role.point else {}
            of_pieces.append(role.positions(q_s, q_f, points).reshape(role.count, role.size))
        return jnp.concatenate(of_pieces)


class Source(NamedTuple):
    """Some elements of an effect, whose name is the key of its parameters.

    count: number of these elements.
    select: their indices; None for all.
    """

    name: str
    count: int
    select: tuple[int, ...] | None = None


@dataclass(frozen=True)
class EffectTerm:
    """The function of one or more effects of a kind on some of their elements.

    sources: the elements.
    roles: the maps from q_s and q_f to the coordinates of each role, `Role` or `Roles`.
    split: names of the parameters that have an entry for each element.
    timed: whether the first argument of the function is the time.
    is_joined: whether the terms of several effects with this function are one term, see `joined`.
    through: ``through(q, params)``, the argument q of the function by the coordinates of each role; None if it is these coordinates.
    """

    sources: tuple[Source, ...]
    function: Callable
    roles: tuple[Any, ...]
    split: tuple[str, ...] = ()
    timed: bool = False
    is_joined: bool = False
    through: Callable | None = None

    def params_of(self, params):
        """The params of the function: the parameters of the effects for their elements, one after the other."""
        of_each = [
            params[name] if select is None else choose(params[name], select, self.split)
            for name, _, select in self.sources
        ]
        if len(of_each) == 1:
            return of_each[0]
        return {
            name: jnp.concatenate(
                [_rows(numbers[name], source.count) for numbers, source in zip(of_each, self.sources, strict=True)]
            )
            for name in self.split
        }

    def value(self, q_s, q_f, params, t=None):
        """Energy or constraint values."""
        params = self.params_of(params)
        return self.function(*((t,) if self.timed else ()), self._map(params)(q_s, q_f), params)

    def kinetic(self, q_s, q_f, v_s, v_f, params):
        """Velocity-dependent energy."""
        params = self.params_of(params)
        return self.function(*jax.jvp(self._map(params), (q_s, q_f), (v_s, v_f)), params)

    def forces(self, t, q_s, q_f, v_s, v_f, params):
        """Force on all slow and on all fast coordinates."""
        params = self.params_of(params)
        q, v = jax.jvp(self._map(params), (q_s, q_f), (v_s, v_f))
        return self._put(self.function(t, q, v, params), params, q_s, q_f)

    def controlled(self, q_s, q_f, u, params):
        """Force of the controls u on all slow and on all fast coordinates."""
        params = self.params_of(params)
        return self._put(self.function(self._map(params)(q_s, q_f), u, params), params, q_s, q_f)

    def of_roles(self, coordinates: Iterable[Any], params) -> tuple[Any, ...]:
        """The argument q of the function, by the coordinates of each role."""
        return tuple(coordinates) if self.through is None else self.through(coordinates, params)

    def _map(self, params) -> Callable:
        """The map from (q_s, q_f) to the argument q of the function."""
        return lambda q_s, q_f: self.of_roles((role.positions(q_s, q_f, params) for role in self.roles), params)

    def _put(self, forces, params, q_s, q_f):
        """Forces F on the argument q of the function, as forces ``(dq/dq_s)^T F`` and ``(dq/dq_f)^T F``."""
        q, pull = jax.vjp(self._map(params), q_s, q_f)
        return pull(tuple(jnp.broadcast_to(jnp.asarray(f, float), x.shape) for f, x in zip(forces, q, strict=True)))

    @property
    def places(self) -> list[Place]:
        """Places of the coordinates that the term depends on."""
        return [*chain(*(piece.rows.places for role in self.roles for piece in role.pieces if piece.rows))]


@dataclass(frozen=True)
class TangentDamping:
    """``F = -beta K v`` with the Hessian K of the energy of some terms; beta is the parameter "stiffness"."""

    terms: tuple[EffectTerm, ...]
    name: str

    def forces(self, t, q_s, q_f, v_s, v_f, params):
        """Force on all slow and on all fast coordinates."""

        def energy(q):
            q_s, q_f = q
            return total([term.value(q_s, q_f, params) for term in self.terms])

        # K v as the derivative of the gradient along v, without the matrix K
        products = jax.jvp(jax.grad(energy), ((q_s, q_f),), ((v_s, v_f),))[1]
        return tuple(-params[self.name]["stiffness"] * product for product in products)

    @property
    def places(self) -> list[Place]:
        """Places of the coordinates that the terms depend on."""
        return [*chain(*(term.places for term in self.terms))]


def choose(params, select: Sequence[int], split: Sequence[str]):
    """The parameters of some elements; each parameter in `split` has an entry for each element, or one number for all."""
    return params | {name: pick(params[name], select) for name in split if jnp.ndim(params[name])} if split else params


def _rows(numbers, count: int):
    """A parameter of `count` elements with an axis for them, which a single element and a number for all elements lack."""
    numbers = jnp.asarray(numbers)
    return numbers[None] if count == 1 else jnp.broadcast_to(numbers, (count,)) if numbers.ndim == 0 else numbers


def joined(terms: Iterable[Any], in_order: bool = False) -> tuple[Any, ...]:
    """The terms, with one term in place of several of one kind; if `in_order`, of neighbours alone, so that the elements keep their order."""
    groups: dict[Any, list] = {}
    last, run = None, 0
    for term in terms:
        kind: Any = id(term)
        if getattr(term, "is_joined", False):
            kind = term.function, term.through, tuple(role.size for role in term.roles), term.split, term.timed
        run += in_order and kind != last
        groups.setdefault((run, kind), []).append(term)
        last = kind
    return tuple(map(_as_one, groups.values()))


def _as_one(terms: Sequence[Any]) -> Any:
    """A term of all elements of terms of one kind."""
    if len(terms) == 1:
        return terms[0]
    roles = (Roles.joined(roles) for roles in zip(*(term.roles for term in terms), strict=True))
    return replace(terms[0], sources=tuple(chain(*(term.sources for term in terms))), roles=tuple(roles))


def pick(values, select: Sequence[int]):
    """Entries of an array by static slices; a single entry without its axis."""
    if len(select) == 1:
        return values[select[0]]
    if list(select) == list(range(select[0], select[0] + len(select))):
        return values[select[0] : select[0] + len(select)]
    return library(values).stack([values[i] for i in select])


def total(values: Sequence):
    """Sum of one or more arrays."""
    return reduce(add, values)


def totals(pairs: Sequence):
    """Sum of pairs (slow, fast): the pair of the sums."""
    return tuple(total(parts) for parts in zip(*pairs, strict=True))

"""Terms: effects as functions of the coordinates of bodies, of which `vmri_jax.scene.functions` makes the functions of
a `System`.

All classes here are compared by value: scenes of the same structure give equal functions, which JAX compiles only once.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
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

ARGUMENTS: dict[str, tuple[str, ...]] = {
    "potential": ("q",),
    "constraint": ("q",),
    "kinetic": ("q", "v"),
    "force": ("t", "q", "v"),
    "control": ("q", "u"),
}
"""For each kind of effects the arguments of its function before params; a constraint that depends on time gets t before
them."""


@dataclass(frozen=True)
class Applied:
    """A function with its first arguments filled in; compared by value, which `functools.partial` is not."""

    function: Callable
    arguments: tuple[Any, ...]

    def __call__(self, *arguments):
        return self.function(*self.arguments, *arguments)


def is_of_package(function: Callable) -> bool:
    """Whether a function, with all functions that are filled in, is part of this package: these act element by element
    on any number of elements.

    A function of the user may be right for a single element alone, such as ``sum(q**2)**2``.
    """
    if isinstance(function, Applied):
        return all(is_of_package(part) for part in (function.function, *function.arguments) if callable(part))
    return str(getattr(function, "__module__", "")).startswith(f"{__name__.partition('.')[0]}.")


def split(q):
    """Centre (..., 3) and directors (..., k, 3), a director per row, of the coordinates q (..., 3 + 3 k) of a rigid
    body."""
    triples = q.reshape(*q.shape[:-1], -1, 3)
    return triples[..., 0, :], triples[..., 1:, :]


def place(q, weights):
    """``phi + sum_i X_i d_i``, (..., 3), of the coordinates q of a body, which may have fewer than three directors, and
    the components X of a point."""
    phi, d = split(q)
    return phi + (weights[..., : d.shape[-2], None] * d).sum(axis=-2)


@dataclass(frozen=True)
class Role:
    """The map from q_s and q_f to the bodies, or to points in them, that elements between bodies of one kind have in
    one role: linear but on the ground.

    rows: coordinates of the bodies, all of one kind; None for the ground.
    count, size: number of elements, and of coordinates that the function takes of each.
    point: name of the parameter with the components X of points ``phi + sum_i X_i d_i`` fixed in rigid bodies or, on
        the ground, of points in space; "" for bodies themselves. The ground itself is a rigid body with the axes of
        space.
    """

    rows: Rows | None
    count: int
    size: int
    point: str = ""

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
    arguments: names of the arguments of the function before params, see `ARGUMENTS`.
    roles: for each role the maps from (q_s, q_f) to the coordinates of its bodies: of the elements between bodies of
        one kind, then of another kind, and so on.
    split: names of the parameters that have an entry for each element.
    is_joined: whether the terms of several effects with this function are one term, see `joined`.
    through: ``through(q, params)``, the argument q of the function by the coordinates of each role; None if it is these
        coordinates.
    """

    sources: tuple[Source, ...]
    function: Callable
    arguments: tuple[str, ...]
    roles: tuple[tuple[Role, ...], ...]
    split: tuple[str, ...] = ()
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

    def __call__(self, values: Mapping[str, Any], params):
        """The value of the function: an energy, values of constraints, or forces on its argument q.

        Args:
            values: (q_s, q_f) as "q", their rates as "v", and "t" and "u", as far as the function takes them.
            params: the parameters of all effects by name.
        """
        params = self.params_of(params)
        values = dict(values)
        if "v" in self.arguments:
            values["q"], values["v"] = jax.jvp(self._map(params), values["q"], values["v"])
        else:
            values["q"] = self._map(params)(*values["q"])
        return self.function(*(values[name] for name in self.arguments), params)

    def forces(self, values: Mapping[str, Any], params):
        """Forces F on the argument q of the function, as forces ``(dq/dq_s)^T F`` and ``(dq/dq_f)^T F``; arguments as
        of a call."""
        q, pull = jax.vjp(self._map(self.params_of(params)), *values["q"])
        forces = zip(self(values, params), q, strict=True)
        return pull(tuple(jnp.broadcast_to(jnp.asarray(f, float), x.shape) for f, x in forces))

    def of_roles(self, coordinates: Iterable[Any], params) -> tuple[Any, ...]:
        """The argument q of the function, by the coordinates of each role."""
        return tuple(coordinates) if self.through is None else self.through(coordinates, params)

    def _map(self, params) -> Callable:
        """The map from (q_s, q_f) to the argument q of the function."""
        return lambda q_s, q_f: self.of_roles((_positions(role, q_s, q_f, params) for role in self.roles), params)

    @property
    def places(self) -> list[Place]:
        """Places of the coordinates that the term depends on."""
        return [place for of_kind in chain(*self.roles) if of_kind.rows for place in of_kind.rows.places]


def stiffness_times(energy: Callable, q, v, params):
    """``K v`` with the Hessian K of an energy by its argument q, as the derivative of the gradient along v."""
    return jax.jvp(jax.grad(lambda q: energy(q, params)), (q,), (v,))[1]


@dataclass(frozen=True)
class TangentDamping:
    """``F = -beta K v``, K v the sum of `terms`, forces by `stiffness_times`; beta is the parameter "stiffness".

    The Hessian K of a potential is by the points or the freedoms of joints that the potential is a function of: by
    other coordinates K would have a part ``dV/dx d^2x/dq^2``, which depends on the choice of the coordinates q.
    """

    terms: tuple[EffectTerm, ...]
    name: str

    def forces(self, values, params):
        """Force on (q_s, q_f), as of `EffectTerm`."""
        products = total([term.forces(values, params) for term in self.terms])
        return tuple(-params[self.name]["stiffness"] * product for product in products)

    @property
    def places(self) -> list[Place]:
        """Places of the coordinates that the terms depend on."""
        return [*chain(*(term.places for term in self.terms))]


def _positions(role: Sequence[Role], q_s, q_f, params):
    """Coordinates or points of all elements in a role, (d,) or (n, d)."""
    if len(role) == 1:
        return role[0].positions(q_s, q_f, params)
    of_kinds, end = [], 0
    for of_kind in role:
        first, end = end, end + of_kind.count
        points = {of_kind.point: pick(params[of_kind.point], range(first, end))} if of_kind.point else {}
        of_kinds.append(of_kind.positions(q_s, q_f, points).reshape(of_kind.count, of_kind.size))
    return jnp.concatenate(of_kinds)


def choose(params, select: Sequence[int], split: Sequence[str]):
    """The parameters of some elements; each parameter in `split` has an entry for each element, or one number for
    all."""
    return params | {name: pick(params[name], select) for name in split if jnp.ndim(params[name])} if split else params


def _rows(numbers, count: int):
    """A parameter of `count` elements with an axis for them, which a single element and a number for all elements
    lack."""
    numbers = jnp.asarray(numbers)
    return numbers[None] if count == 1 else jnp.broadcast_to(numbers, (count,)) if numbers.ndim == 0 else numbers


def joined(terms: Iterable[Any], in_order: bool = False) -> tuple[Any, ...]:
    """The terms, with one term in place of several of one kind; if `in_order`, of neighbours alone, so that the
    elements keep their order."""
    groups: dict[Any, list] = {}
    last, run = None, 0
    for term in terms:
        kind: Any = id(term)
        if getattr(term, "is_joined", False):
            kind = term.function, term.arguments, term.through, tuple(role[0].size for role in term.roles), term.split
        run += in_order and kind != last
        groups.setdefault((run, kind), []).append(term)
        last = kind
    return tuple(map(_as_one, groups.values()))


def _as_one(terms: Sequence[Any]) -> Any:
    """A term of all elements of terms of one kind."""
    if len(terms) == 1:
        return terms[0]
    roles = tuple(_role_of_all(chain(*roles)) for roles in zip(*(term.roles for term in terms), strict=True))
    return replace(terms[0], sources=tuple(chain(*(term.sources for term in terms))), roles=roles)


def _role_of_all(roles: Iterable[Any]) -> tuple[Role, ...]:
    """The maps of elements one after the other, those of neighbours with bodies of one kind as one."""
    of_kinds = []
    for (stride, _), (*same,) in groupby(roles, key=lambda role: (role.rows and role.rows.stride, role.point)):
        rows = Rows.of([*chain(*(role.rows.places for role in same))], same[0].rows.size) if stride else None
        of_kinds.append(replace(same[0], rows=rows, count=sum(role.count for role in same)))
    return tuple(of_kinds)


def pick(values, select: Sequence[int]):
    """Entries of an array by static slices; a single entry without its axis."""
    if len(select) == 1:
        return values[select[0]]
    if list(select) == list(range(select[0], select[0] + len(select))):
        return values[select[0] : select[0] + len(select)]
    return library(values).stack([values[i] for i in select])


def total(values: Sequence) -> Any:
    """Sum of at least one array, or of at least one pair (slow, fast) of arrays."""
    return jax.tree.map(lambda *parts: reduce(add, parts), *values)

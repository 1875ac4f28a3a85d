"""Effects: what a scene calls for. Each contributes one function to the Lagrangian, the constraints or the forces."""

import difflib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from itertools import combinations
from typing import Any, ClassVar, Literal

import jax
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete
from vmri_jax.scene.body import Body
from vmri_jax.scene.layout import Place, Rows
from vmri_jax.scene.terms import Term, choose

Kind = Literal["kinetic", "potential", "constraint", "force"]
Elements = tuple[tuple[str, ...], ...]


@dataclass(frozen=True, eq=False)
class Effect(ABC):
    """What every effect says: its function, the bodies it touches, its parameters.

    An effect has one or more *elements*, each between as many bodies as it has roles: a spring has the roles a and b, and
    an effect of ten springs has ten elements. Its function depends on `kind`:

    | kind | function | returns |
    |---|---|---|
    | "potential" | ``function(q, params)`` | energy, () |
    | "constraint" | ``function(q, params)``, `timed` ``function(t, q, params)`` | values that are kept zero, (k,) or () for each element |
    | "kinetic" | ``function(q, v, params)`` | energy added to ``sum m v^2 / 2``, () |
    | "force" | ``function(t, q, v, params)`` | tuple of forces, shaped like q |

    q and v are tuples with one entry per role: the coordinates (d,) of its body or, with n > 1 elements, (n, d).

    Args:
        name: of this effect in its scene; by default the name of its class.
        rate: of a potential, "slow" (V), "fast" (W) or "auto", by stiffness; of a kinetic effect likewise, but it only
            makes bodies fast: these terms are all on the micro grid.
    """

    kind: ClassVar[Kind]
    default_name: ClassVar[str] = ""
    same_size: ClassVar[bool] = True
    numbers: ClassVar[tuple[str, ...]] = ()
    """Parameters that are one number for all elements, (), or one for each, (n,)."""
    vectors: ClassVar[tuple[str, ...]] = ()
    """Parameters that are one vector for each element, (n, d), of a single one (d,)."""
    function: ClassVar[Any]
    timed: ClassVar[bool] = False
    """Whether a constraint depends on time."""

    name: str = field(default="", kw_only=True)
    rate: Literal["slow", "fast", "auto"] = field(default="auto", kw_only=True)

    def __post_init__(self):
        for argument in fields(self):
            object.__setattr__(self, argument.name, lasting(getattr(self, argument.name)))
        if not self.name:
            object.__setattr__(self, "name", self.default_name)
        if self.rate not in ("slow", "fast", "auto"):
            raise ValueError(f"{self.name}: rate is {self.rate!r}; it must be 'slow', 'fast' or 'auto'.")

    def one(self, params: dict[str, Any], i: int, bodies: Mapping[str, Body]) -> dict[str, Any]:
        """The parameters of element i among those of all."""
        single = len(self.elements(bodies)) == 1
        return params if single else choose(params, (i,), self.numbers + self.vectors)

    @property
    def refers_to(self) -> tuple[str, ...]:
        """Names of the potentials that this effect builds on."""
        return ()

    @abstractmethod
    def elements(self, bodies: Mapping[str, Body]) -> Elements:
        """Names of the bodies of every element."""

    @abstractmethod
    def parameters(self, bodies: Mapping[str, Body]) -> dict[str, Any]:
        """What the function gets as params: arrays by name."""

    def check(self, bodies: Mapping[str, Body]) -> None:
        """Refuse what is wrong with this effect between these bodies.

        Raises:
            ValueError: unknown bodies, a body twice in one element, bodies of different dimension, and what the
                effect's own numbers forbid.
        """
        for element in self.elements(bodies):
            for name in element:
                if name not in bodies:
                    raise ValueError(f"{self.name}: {unknown('body', name, bodies)}")
            twice = [name for name in element if element.count(name) > 1]
            if twice:
                raise ValueError(
                    f"{self.name}: {twice[0]} occurs twice in {element}; an element is between different bodies."
                )
            self._check_sizes(element if self.same_size else (), bodies)
        self._check_sizes([element[0] for element in self.elements(bodies)] if self.vectors else (), bodies)
        count = len(self.elements(bodies))
        for name, value in self.parameters(bodies).items():
            if name in self.numbers and np.shape(value) not in ((), (count,)):
                raise ValueError(
                    f"{self.name}: {name} has shape {np.shape(value)}; give one number, or one for each of the {count} elements."
                )
            for leaf in jax.tree.leaves(value):
                if is_concrete(leaf) and not np.isfinite(leaf).all():
                    raise ValueError(f"{self.name}: {name} is {np.asarray(leaf)}, which is not finite.")

    def _check_sizes(self, names: Sequence[str], bodies: Mapping[str, Body]) -> None:
        sizes = {name: bodies[name].size for name in names}
        if len(set(sizes.values())) > 1:
            described = ", ".join(f"{name} {size}" for name, size in sizes.items())
            raise ValueError(f"{self.name}: bodies of different dimension ({described}); they must be of the same.")

    def terms(
        self,
        select: Sequence[int],
        bodies: Mapping[str, Body],
        places: Mapping[str, Place],
        potentials: Mapping[str, Any],
    ) -> tuple[Any, ...]:
        """The terms of some of the elements; those of bodies of other sizes in another term.

        Args:
            select: indices of elements.
            places: of all bodies in q_s and q_f.
            potentials: terms of all potentials of the scene by name of the effect.
        """
        elements, by_size = self.elements(bodies), {}
        for i in select:
            by_size.setdefault(tuple(places[name].size for name in elements[i]), []).append(i)
        return tuple(
            Term(
                self.name,
                self.function,
                tuple(Rows.of([places[elements[i][role]] for i in some]) for role in range(len(elements[some[0]]))),
                None if len(some) == len(elements) else tuple(some),
                self.numbers + self.vectors,
                self.timed,
            )
            for some in by_size.values()
        )

    def curvature(self, bodies: Mapping[str, Body]):
        """Largest second derivative of the energy of each element, () or (n,), where its start does not show it, else None."""
        return None

    def drawing(self, bodies: Mapping[str, Body]) -> dict[str, list]:
        """What there is to see of it, see `vmri_jax.scene.drawing`."""
        return {}

    def require(self, condition: Any, what: str, value: Any, expected: str) -> None:
        """Raise ValueError unless a condition on concrete numbers holds everywhere."""
        if is_concrete(condition) and not np.all(condition):
            shown = np.asarray(value) if is_concrete(value) else value
            raise ValueError(f"{self.name}: {what} is {shown}; {expected}.")

    def require_positive(self, **values) -> None:
        """Raise ValueError unless all these numbers are positive."""
        for name, value in values.items():
            if is_concrete(value):
                self.require(np.asarray(value) > 0, name, value, "it must be positive")


def lasting(value):
    """A value that can be gone through again: an iterator, or a list with iterators in it, as a tuple."""
    if isinstance(value, Iterator) or (isinstance(value, list | tuple) and any(isinstance(v, Iterator) for v in value)):
        return tuple(lasting(item) for item in value)
    return value


def groups(between, size: int, what: str) -> Elements:
    """Elements of `size` bodies, from one of them, ``("a", "b")``, or several, ``[("a", "b"), ("b", "c")]``."""
    items = (between,) if isinstance(between, str) else tuple(between)
    if size > 1 and items and all(isinstance(item, str) for item in items):
        items = (items,)
    elements = tuple((item,) if isinstance(item, str) else tuple(item) for item in items)
    if not elements or any(len(element) != size for element in elements):
        raise ValueError(f"{what}: between is {between!r}; give {size} names of bodies, or a list of such.")
    return elements


def all_pairs(between, bodies: Mapping[str, Body], what: str) -> Elements:
    """All pairs of a list of bodies (of all bodies if None), or the given pairs."""
    items = tuple(bodies) if between is None else tuple(between)
    if items and all(isinstance(item, str) for item in items):
        if len(items) < 2:
            raise ValueError(f"{what}: between is {between!r}; give at least two bodies, or a list of pairs.")
        return tuple(combinations(items, 2))
    return groups(items, 2, what)


def each(bodies_of, bodies: Mapping[str, Body], what: str) -> Elements:
    """Every body for itself: of a list, or of the whole scene if None."""
    return groups(tuple(bodies) if bodies_of is None else bodies_of, 1, what)


def unknown(kind: str, name: Any, known: Iterable[str]) -> str:
    """The sentence that there is none of that name, with the near miss."""
    known = list(known)
    near = difflib.get_close_matches(str(name), known, n=1)
    hint = f" Did you mean {near[0]}?" if near else ""
    return f"there is no {kind} {name!r}.{hint} There are {', '.join(known) or 'none'}."

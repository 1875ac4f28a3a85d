"""Effects: what a scene calls for. Each contributes one function to the Lagrangian, the constraints or the forces."""

from abc import ABC
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import field, fields
from itertools import pairwise
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete, real_array
from vmri_jax.mechanics.names import Place, unknown
from vmri_jax.scene.body import Bodies
from vmri_jax.scene.declare import Elements, Parameter, effect_class, squeeze
from vmri_jax.scene.layout import Rows
from vmri_jax.scene.terms import EffectTerm, choose

Kind = Literal["kinetic", "potential", "constraint", "force"]
DRAWN = {"link": "links", "spring": "springs"}
"""What joins two bodies in a drawing, and its entry there."""
START = 1e-9
"""How far, relative to its size, what a constraint keeps may be from its value at the start."""


@effect_class
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

    q and v are tuples with one entry per role: the coordinates (d,) of its body or, with n > 1 elements, (n, d). params
    are the fields that a class declares as numbers, vectors or arrays (see `vmri_jax.scene.declare`), by name.

    `bodies` of its methods are those of the scene, by name.

    Args:
        name: of this effect in its scene; by default the name of its class.
        rate: of a potential, "slow" (V), "fast" (W) or "auto", by stiffness; of a kinetic effect likewise, but it only
            makes bodies fast: these terms are all on the micro grid.
    """

    kind: ClassVar[Kind]
    function: ClassVar[Any]
    rest: ClassVar[Any] = None
    """``rest(q, params) -> ()``: the value at the start of a parameter that is `measured`, of one element."""
    default_name: ClassVar[str] = ""
    timed: ClassVar[bool] = False
    """Whether a constraint depends on time."""
    dimensions: ClassVar[tuple[int, ...]] = ()
    """Its bodies are points of one of these dimensions; if there are none, they may be blocks of general coordinates too."""
    same_size: ClassVar[bool] = True
    """All bodies of an element have the same dimension."""
    apart: ClassVar[bool] = False
    """Neighbouring bodies of an element, or a body and the point it is tied to, must not start at one place."""
    masses: ClassVar[tuple[str, ...]] = ()
    """The masses of the bodies are parameters of these names, role by role."""
    derived: ClassVar[tuple[str, ...]] = ()
    """Parameters besides the declared ones that have a number for each element."""
    drawn_as: ClassVar[Literal["link", "spring"] | None] = None
    """What is drawn between neighbouring bodies of an element."""

    name: str = field(default="", kw_only=True)
    rate: Literal["slow", "fast", "auto"] = field(default="auto", kw_only=True)

    def __post_init__(self):
        for argument in fields(self):
            object.__setattr__(self, argument.name, lasting(getattr(self, argument.name)))
        if not self.name:
            object.__setattr__(self, "name", self.default_name)
        if self.rate not in ("slow", "fast", "auto"):
            raise ValueError(f"{self.name}: rate is {self.rate!r}; it must be 'slow', 'fast' or 'auto'.")

    @property
    def declared(self) -> dict[str, Parameter]:
        """The declared parameters by name."""
        return {f.name: f.metadata["parameter"] for f in fields(self) if "parameter" in f.metadata}

    @property
    def split(self) -> tuple[str, ...]:
        """Names of parameters that have an entry for each element, or one for all."""
        declared = [name for name, parameter in self.declared.items() if parameter.shape in ("number", "vector")]
        return (*declared, *self.masses, *self.derived)

    @property
    def refers_to(self) -> tuple[str, ...]:
        """Names of the potentials that this effect builds on."""
        return ()

    def elements(self, bodies: Bodies) -> Elements:
        """Names of the bodies of every element."""
        given = next(f for f in fields(self) if "names" in f.metadata)
        what = f"{self.name}: {given.name}"
        return given.metadata["names"].elements(getattr(self, given.name), bodies, what)

    def parameters(self, bodies: Bodies) -> dict[str, Any]:
        """What the function gets as params: arrays by name."""
        params, elements = {}, self.elements(bodies)
        firsts = [bodies[element[0]] for element in elements]
        for name, parameter in self.declared.items():
            if getattr(self, name) is not None:
                params[name] = parameter.array(f"{self.name}: {name}", getattr(self, name), firsts)
        for role, name in enumerate(self.masses):
            params[name] = squeeze(jnp.stack([self._mass(element[role], bodies) for element in elements]))
        for name, parameter in self.declared.items():
            if parameter.measured and name not in params:
                params[name] = self.at_start(bodies, params)
        return params

    def at_start(self, bodies: Bodies, params: dict[str, Any]):
        """The measured value of every element at the start, (n,), or () of a single one."""
        count = len(self.elements(bodies))
        return squeeze(jnp.stack([self.rest(*self.one(i, bodies, params)) for i in range(count)]))

    def one(self, i: int, bodies: Bodies, params: dict[str, Any]) -> tuple[tuple, dict[str, Any]]:
        """Positions of the bodies of element i at the start, and its parameters among those of all."""
        elements = self.elements(bodies)
        q = tuple(bodies[name].position for name in elements[i])
        return q, params if len(elements) == 1 else choose(params, (i,), self.split)

    def check(self, bodies: Bodies) -> None:
        """Refuse what is wrong with this effect between these bodies.

        Raises:
            TypeError: parameters that are no real numbers.
            ValueError: unknown bodies, a body twice in one element, bodies of different dimension, at one point, or of
                general coordinates where points are needed; parameters of another shape, sign or precision, and what
                the effect itself forbids.
        """
        self.check_bodies(bodies)
        self.check_parameters(bodies)

    def check_bodies(self, bodies: Bodies) -> None:
        """Refuse bodies that are not there, or that do not fit."""
        elements = self.elements(bodies)
        for element in elements:
            for name in element:
                if name not in bodies:
                    raise ValueError(f"{self.name}: {unknown('body', name, bodies)}")
                if element.count(name) > 1:
                    raise ValueError(
                        f"{self.name}: {name} occurs twice in {element}; an element is between different bodies."
                    )
                block, size = bodies[name].block, bodies[name].size
                if self.dimensions and (block or size not in self.dimensions):
                    has, allowed = "general " if block else "", " or ".join(map(str, self.dimensions))
                    raise ValueError(
                        f"{self.name}: {name} has {size} {has}coordinates; this effect is between points of dimension {allowed}."
                    )
            if self.same_size:
                self._check_sizes(element, bodies)
        if any(parameter.shape == "vector" for parameter in self.declared.values()):
            self._check_sizes([element[0] for element in elements], bodies)

    def check_parameters(self, bodies: Bodies) -> None:
        """Refuse bodies at one place, parameters of another shape or sign, that are not finite, or that are not what a constraint keeps."""
        if self.apart:
            self.require_apart(bodies)
        params = self.parameters(bodies)
        for name, value in params.items():
            for leaf in jax.tree.leaves(value):
                if is_concrete(leaf) and not np.isfinite(leaf).all():
                    raise ValueError(f"{self.name}: {name} is {np.asarray(leaf)}, which is not finite.")
        for name, parameter in self.declared.items():
            given = getattr(self, name)
            if given is None:
                continue
            parameter.check_sign(f"{self.name}: {name}", given)
            if parameter.measured and self.kind == "constraint":
                self._check_start(name, bodies, params)

    def by_size(self, select: Sequence[int], bodies: Bodies) -> list[list[int]]:
        """Some of the elements, those between bodies of the same sizes together: each of these is a term.

        Args:
            select: indices of elements.
        """
        elements, found = self.elements(bodies), {}
        for i in select:
            found.setdefault(tuple(bodies[name].size for name in elements[i]), []).append(i)
        return list(found.values())

    def terms(self, select: Sequence[int], bodies: Bodies, places: Mapping[str, Place], potentials: Mapping[str, Any]):
        """The terms of some of the elements; those of bodies of other sizes in another term.

        Args:
            select: indices of elements.
            places: of all bodies in q_s and q_f.
            potentials: terms of all potentials of the scene by name of the effect.
        """
        elements, terms = self.elements(bodies), []
        for some in self.by_size(select, bodies):
            roles = zip(*(elements[i] for i in some), strict=True)
            rows = tuple(Rows.of([places[name] for name in role]) for role in roles)
            chosen = None if len(some) == len(elements) else tuple(some)
            terms.append(EffectTerm(self.name, self.function, rows, chosen, self.split, self.timed))
        return tuple(terms)

    def curvature(self, bodies: Bodies):
        """Largest second derivative of the energy of each element, () or (n,), where its start does not show it, else None."""
        return None

    def drawing(self, bodies: Bodies) -> dict[str, list]:
        """What there is to see of it: entries of `Scene.drawing`, and "radii" of bodies, pairs of name and number."""
        if self.drawn_as is None:
            return {}
        return {DRAWN[self.drawn_as]: [list(pair) for element in self.elements(bodies) for pair in pairwise(element)]}

    def require(self, condition: Any, what: str, value: Any, expected: str) -> None:
        """Raise ValueError unless a condition on concrete numbers holds everywhere.

        Args:
            what, value, expected: for the message, "{what} is {value}; {expected}."
        """
        if is_concrete(condition) and not np.all(condition):
            shown = np.asarray(value) if is_concrete(value) else value
            raise ValueError(f"{self.name}: {what} is {shown}; {expected}.")

    def require_apart(self, bodies: Bodies) -> None:
        """Refuse elements whose neighbouring bodies are at one point at the start."""
        for a, b in (pair for element in self.elements(bodies) for pair in pairwise(element)):
            apart = jnp.sqrt(jnp.sum((bodies[b].position - bodies[a].position) ** 2))
            expected = "they must not start at the same point; move one of them"
            self.require(apart > 0, f"the distance of {a} and {b}", apart, expected)

    def _mass(self, name: str, bodies: Bodies):
        """The one mass of a body."""
        if bodies[name].mass.ndim:
            raise ValueError(
                f"{self.name}: {name} has a mass for each coordinate; it needs bodies with one mass. Give bodies=."
            )
        return bodies[name].mass

    def _check_sizes(self, names: Sequence[str], bodies: Bodies) -> None:
        sizes = {name: bodies[name].size for name in names}
        if len(set(sizes.values())) > 1:
            described = ", ".join(f"{name} {size}" for name, size in sizes.items())
            raise ValueError(f"{self.name}: bodies of different dimension ({described}); they must be of the same.")

    def _check_start(self, name: str, bodies: Bodies, params: dict[str, Any]) -> None:
        """Refuse a value that a constraint keeps and that is not the one at the start."""
        start = self.at_start(bodies, params)
        if not is_concrete((params[name], start)):
            return
        values = np.broadcast_arrays(np.atleast_1d(params[name]), start)
        for element, given, found in zip(self.elements(bodies), *values, strict=True):
            right = abs(given - found) <= START * given
            expected = f"it starts as {found:.12g}; give that, or move a body"
            self.require(right, f"{name} of {'-'.join(element)}", f"{given:g}", expected)


def lasting(value):
    """A value that can be gone through again: an iterator, or a list with iterators in it, as a tuple."""
    if isinstance(value, Iterator) or (isinstance(value, list | tuple) and any(isinstance(v, Iterator) for v in value)):
        return tuple(lasting(item) for item in value)
    return value


def real_tree(what: str, tree):
    """A pytree of real numbers as one of arrays; what is neither is refused by its place in the tree.

    Args:
        what: its name, for messages.
        tree: numbers, arrays, lists and dictionaries of them.
    """

    def convert(path, leaf):
        return jnp.asarray(real_array(what + jax.tree_util.keystr(path), leaf))

    return jax.tree_util.tree_map_with_path(convert, tree)

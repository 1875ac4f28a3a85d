"""Effects: what a scene calls for. Each contributes one function to the Lagrangian, the constraints or the forces."""

from abc import ABC
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import field, fields, replace
from itertools import pairwise
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete, real_array
from vmri_jax.mechanics.functions import check_arguments
from vmri_jax.mechanics.names import unknown
from vmri_jax.mechanics.rows import Place, Rows
from vmri_jax.scene.body import GROUND, Attachment, Bodies, body_of, end_of, label_of, moving
from vmri_jax.scene.declare import Elements, Parameter, effect_class, squeeze
from vmri_jax.scene.layout import Layout
from vmri_jax.scene.terms import EffectTerm, InRigidBodies, OnBodies, OnGround, Role, choose

Kind = Literal["kinetic", "potential", "constraint", "force", "control"]
DRAWN = {"link": "links", "spring": "springs"}
"""What joins two bodies in a drawing, and its entry there."""
MOST_ROLES = 32
"""Bodies of an element at most: those of sixteen joints that one equation ties."""
POINTS = tuple(f"at_{role}" for role in range(MOST_ROLES))
"""Parameters with the points fixed in rigid bodies, role by role."""
ALONE = "alone"
"""What the term of a single element is called."""
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
    | "control" | ``function(q, u, params)`` | tuple of forces of the controls u, shaped like q |

    q and v are tuples with one entry per role: the coordinates (d,) of its body or, with n > 1 elements, (n, d). Of a rigid
    body these are its centre's, or those of the point that is given with its name. The ground is a body, too. params
    are the fields that a class declares as numbers, vectors or arrays (see `vmri_jax.scene.declare`), by name.

    `bodies` of its methods are those of the scene, by name.

    Args:
        name: of this effect in its scene; by default the name of its class.
        rate: of a potential, "slow" (V), "fast" (on the micro grid, with the rule of W), a whole number k (on every k-th micro node), or
            "auto", by stiffness. Of a kinetic effect "slow", "fast" or "auto", but it only makes bodies fast: these terms are all on the
            micro grid. Bodies that a potential with the rate "fast" or k touches are fast, unless they are given as slow: then the
            equations of the slow bodies are implicit in it.
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
    whole: ClassVar[bool] = False
    """Its function gets all coordinates of a rigid body, not those of its centre."""
    drawn_as: ClassVar[Literal["link", "spring"] | None] = None
    """What is drawn between neighbouring bodies of an element."""

    name: str = field(default="", kw_only=True)
    rate: Literal["slow", "fast", "auto"] | int = field(default="auto", kw_only=True)

    def __post_init__(self):
        for argument in fields(self):
            object.__setattr__(self, argument.name, lasting(getattr(self, argument.name)))
        if not self.name:
            object.__setattr__(self, "name", self.default_name)
        for argument in fields(self):
            if "of_time" in argument.metadata:
                what, function = f"{self.name}: {argument.name}", getattr(self, argument.name)
                if not callable(function):
                    raise TypeError(f"{what} is {function!r}; give a function of (t, params).")
                check_arguments(what, function, "t, params")
        is_number = isinstance(self.rate, int) and not isinstance(self.rate, bool) and self.rate > 0
        if not (is_number and self.kind == "potential") and self.rate not in ("slow", "fast", "auto"):
            number = ", or of a potential a whole number k, for every k-th micro node"
            raise ValueError(f"{self.name}: rate is {self.rate!r}; it must be 'slow', 'fast' or 'auto'{number}.")

    @property
    def declared(self) -> dict[str, Parameter]:
        """The declared parameters by name."""
        return {f.name: f.metadata["parameter"] for f in fields(self) if "parameter" in f.metadata}

    @property
    def split(self) -> tuple[str, ...]:
        """Names of parameters that have an entry for each element, or one for all."""
        declared = [name for name, parameter in self.declared.items() if parameter.shape in ("number", "vector")]
        return (*declared, *self.masses, *self.derived, *POINTS)

    @property
    def refers_to(self) -> tuple[str, ...]:
        """Names of the potentials that this effect builds on."""
        return ()

    def bound(self, effects: Sequence["Effect"]) -> "Effect":
        """The same with other effects that it builds on, instead of their names.

        Args:
            effects: of the scene.

        Raises:
            ValueError: one of them is not there.
        """
        return self

    def elements(self, bodies: Bodies) -> Elements:
        """Names of the bodies of every element."""
        given = next(f for f in fields(self) if "names" in f.metadata)
        what = f"{self.name}: {given.name}"
        return given.metadata["names"].elements(getattr(self, given.name), bodies, what)

    def parameters(self, bodies: Bodies) -> dict[str, Any]:
        """What the function gets as params: arrays by name."""
        params, elements = {}, self.elements(bodies)
        firsts = [end_of(bodies, element[0], self.whole) for element in elements]
        for name, parameter in self.declared.items():
            if getattr(self, name) is not None:
                params[name] = parameter.array(f"{self.name}: {name}", getattr(self, name), firsts)
        for role, name in enumerate(self.masses):
            params[name] = squeeze(jnp.stack([self._mass(element[role], bodies) for element in elements]))
        params |= self.points(bodies)
        for name, parameter in self.declared.items():
            if parameter.measured and name not in params:
                params[name] = self.at_start(bodies, params)
        return params

    def points(self, bodies: Bodies) -> dict[str, Any]:
        """Points fixed in rigid bodies, role by role, as weights of their directors; of bodies without one, zeros."""
        found = {}
        for at, role in zip(POINTS, zip(*self.elements(bodies), strict=True), strict=False):
            if any(isinstance(name, Attachment) for name in role):
                weights = [
                    body_of(bodies, name).weights(name.at) if isinstance(name, Attachment) else np.zeros(3)
                    for name in role
                ]
                found[at] = squeeze(jnp.stack(weights))
        return found

    def at_start(self, bodies: Bodies, params: dict[str, Any]):
        """The measured value of every element at the start, (n,), or () of a single one."""
        count = len(self.elements(bodies))
        return squeeze(jnp.stack([self.rest(*self.one(i, bodies, params)) for i in range(count)]))

    def one(self, i: int, bodies: Bodies, params: dict[str, Any]) -> tuple[tuple, dict[str, Any]]:
        """What the function sees of the bodies of element i at the start, and its parameters among those of all."""
        q = tuple(end_of(bodies, name, self.whole).position for name in self.elements(bodies)[i])
        return q, self._own(i, bodies, params)

    def alone(self, i: int, bodies: Bodies, params: dict[str, Any]) -> tuple[EffectTerm, dict[str, Any]]:
        """Element i as a term on the coordinates of its bodies that move, one after the other as q_s, and its params."""
        places, end = {}, 0
        for name in moving(self.elements(bodies)[i]):
            places[name] = Place("s", end, bodies[name].size)
            end += bodies[name].size
        term = replace(self._term((i,), bodies, places), name=ALONE, select=None)  # one program for all of a kind
        return term, {ALONE: self._own(i, bodies, params)}

    def pairs_of_joints(self, i: int) -> tuple[tuple[str, int], ...]:
        """The joints, and the numbers of their pairs of bodies, whose freedoms are all that element i depends on; () of other effects."""
        return ()

    def _own(self, i: int, bodies: Bodies, params: dict[str, Any]) -> dict[str, Any]:
        """Parameters of element i among those of all."""
        return params if len(self.elements(bodies)) == 1 else choose(params, (i,), self.split)

    def check(self, bodies: Bodies, moved: bool = False) -> None:
        """Refuse what is wrong with this effect between these bodies.

        Args:
            moved: the bodies will be moved onto the constraints, so that what these keep may start otherwise.

        Raises:
            TypeError: parameters that are no real numbers.
            ValueError: unknown bodies, a body twice in one element, bodies of different dimension, at one point, or of
                general coordinates where points are needed; parameters of another shape, sign or precision, and what
                the effect itself forbids.
        """
        self.check_bodies(bodies)
        self.check_parameters(bodies)
        if self.kind == "constraint" and not moved:
            self.check_start(bodies)

    def check_bodies(self, bodies: Bodies) -> None:
        """Refuse bodies that are not there, or that do not fit."""
        elements = self.elements(bodies)
        for element in elements:
            if not moving(element):
                raise ValueError(f"{self.name}: {element} is about the ground alone, which does not move; name a body.")
            for name in element:
                if name not in bodies and name != GROUND:
                    raise ValueError(f"{self.name}: {unknown('body', str(name), [*bodies, GROUND])}")
                if element.count(name) > 1:
                    raise ValueError(
                        f"{self.name}: {name} occurs twice in {element}; an element is between different bodies."
                    )
                try:
                    end = end_of(bodies, name, self.whole)
                except ValueError as error:
                    raise ValueError(f"{self.name}: {error}") from None
                block, size = end.block, end.size
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
        """Refuse bodies at one place, parameters of another shape or sign, or that are not finite."""
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

    def by_size(self, select: Sequence[int], bodies: Bodies) -> list[list[int]]:
        """Some of the elements, those between bodies of the same sizes and kinds together: each of these is a term.

        Args:
            select: indices of elements.
        """
        elements, found = self.elements(bodies), {}
        for i in select:
            found.setdefault(tuple(self._kind(name, bodies) for name in elements[i]), []).append(i)
        return list(found.values())

    def _kind(self, name: str, bodies: Bodies) -> tuple:
        """What bodies of one role of a term have in common."""
        body, end = body_of(bodies, name), end_of(bodies, name, self.whole)
        return name == GROUND, isinstance(name, Attachment), body.size, end.size

    def terms(self, select: Sequence[int], bodies: Bodies, layout: Layout, potentials: Mapping[str, Any]):
        """The terms of some of the elements; those of bodies of other sizes in another term.

        Args:
            select: indices of elements.
            layout: of all bodies.
            potentials: terms of all potentials of the scene by name of the effect.
        """
        return tuple(self._term(some, bodies, layout.bodies) for some in self.by_size(select, bodies))

    def _term(self, some: Sequence[int], bodies: Bodies, places: Mapping[str, Place]) -> EffectTerm:
        """The term of elements of one kind."""
        elements = self.elements(bodies)
        roles = zip(POINTS, zip(*(elements[i] for i in some), strict=True), strict=False)
        made = tuple(self._role(at, role, bodies, places) for at, role in roles)
        chosen = None if len(some) == len(elements) else tuple(some)
        return EffectTerm(self.name, self.function, made, chosen, self.split, self.timed)

    def _role(self, at: str, names: Sequence[str], bodies: Bodies, places: Mapping[str, Place]) -> Role:
        """Where the function gets the coordinates of bodies of one kind from."""
        first, size = names[0], end_of(bodies, names[0], self.whole).size
        attached = isinstance(first, Attachment)
        if first == GROUND:
            return OnGround(len(names), size, at if attached else None)
        own = [places[name] for name in names]
        return InRigidBodies(Rows.of(own), at) if attached else OnBodies(Rows.of(own, size))

    def components(self, bodies: Bodies) -> tuple[str, ...]:
        """Names of the controls of an effect that is one."""
        return ()

    def curvature(self, bodies: Bodies):
        """Largest second derivative of the energy of each element, () or (n,), where its start does not show it, else None."""
        return None

    def drawn_points(self, bodies: Bodies) -> dict[str, tuple[str, Any]]:
        """Points in rigid bodies where something drawn ends: by their names there, body and weights of its directors."""
        if self.drawn_as is None:
            return {}
        names = [name for element in self.elements(bodies) for name in element]
        return {
            name.label: (str(name), bodies[name].weights(name.at))
            for name in names
            if isinstance(name, Attachment) and name != GROUND
        }

    def drawing(self, bodies: Bodies) -> dict[str, list]:
        """What there is to see of it: entries of `Scene.drawing`, and "radii" of bodies, pairs of name and number."""
        if self.drawn_as is None:
            return {}
        pairs = [pair for element in self.elements(bodies) for pair in pairwise(element)]
        between = [[label_of(a), label_of(b)] for a, b in pairs if GROUND not in (a, b)]
        held = [(a, b) if b == GROUND else (b, a) for a, b in pairs if GROUND in (a, b)]
        anchors = [
            {"body": label_of(a), "point": end_of(bodies, b).position.tolist(), "kind": self.drawn_as} for a, b in held
        ]
        return {DRAWN[self.drawn_as]: between, "anchors": anchors}

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
            apart = jnp.sqrt(jnp.sum((end_of(bodies, b).position - end_of(bodies, a).position) ** 2))
            expected = "they must not start at the same point; move one of them"
            self.require(apart > 0, f"the distance of {a} and {b}", apart, expected)

    def _mass(self, name: str, bodies: Bodies):
        """The one mass of a body."""
        mass = end_of(bodies, name).mass
        if mass is None:
            raise ValueError(
                f"{self.name}: {label_of(name)} has no mass of its own; it acts on the masses of whole bodies. Give the name alone."
            )
        if mass.ndim:
            raise ValueError(
                f"{self.name}: {name} has a mass for each coordinate; it needs bodies with one mass. Give bodies=."
            )
        return mass

    def _check_sizes(self, names: Sequence[str], bodies: Bodies) -> None:
        sizes = {name: end_of(bodies, name, self.whole).size for name in names}
        if len(set(sizes.values())) > 1:
            described = ", ".join(f"{name} {size}" for name, size in sizes.items())
            raise ValueError(f"{self.name}: bodies of different dimension ({described}); they must be of the same.")

    def check_start(self, bodies: Bodies) -> None:
        """Refuse a value that a constraint keeps and that is not the one at the start."""
        for name in (name for name, parameter in self.declared.items() if parameter.measured):
            params = self.parameters(bodies)
            start = self.at_start(bodies, params)
            if getattr(self, name) is None or not is_concrete((params[name], start)):
                continue
            values = np.broadcast_arrays(np.atleast_1d(params[name]), start)
            for element, given, found in zip(self.elements(bodies), *values, strict=True):
                right = abs(given - found) <= START * given
                expected = f"it starts as {found:.12g}; give that, move a body, or let the scene do it, project=True"
                self.require(right, f"{name} of {'-'.join(map(label_of, element))}", f"{given:g}", expected)


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

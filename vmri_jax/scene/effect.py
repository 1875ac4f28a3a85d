"""Effects: each adds a function of positions, velocities and time of some bodies to the Lagrangian, the constraints or the forces."""

from abc import ABC
from collections.abc import Mapping, Sequence
from dataclasses import Field, field, fields, replace
from inspect import getattr_static, isfunction
from itertools import pairwise
from typing import Any, ClassVar, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete
from vmri_jax.mechanics.functions import check_arguments
from vmri_jax.mechanics.names import unknown
from vmri_jax.mechanics.rows import Place, Rows
from vmri_jax.scene.body import GROUND, Attachment, Bodies, body_of, end_of, label_of, moving
from vmri_jax.scene.declare import Elements, Parameter, effect_class, lasting, real_tree, squeeze
from vmri_jax.scene.layout import Key, Layout
from vmri_jax.scene.returned import check_function
from vmri_jax.scene.terms import EffectTerm, InRigidBodies, OnBodies, OnGround, Role, choose

Kind = Literal["kinetic", "potential", "constraint", "force", "control"]
DRAWN = {"link": "links", "spring": "springs"}
"""For each symbol that an effect may draw between two bodies, the list of the drawing that holds it."""
MOST_ROLES = 32
"""Most bodies of an element: the two bodies of each of sixteen joints that one equation couples. More are refused."""
POINTS = tuple(f"at_{role}" for role in range(MOST_ROLES))
"""Names of the parameters that hold points fixed in rigid bodies, one for each role."""
ALONE = "alone"
"""Name of the term of a single element, the same for all effects, so that equal functions share a compiled program."""
START = 1e-9
"""Largest violation of a constraint at the start, relative to the value that it keeps. A larger one would start runs off the constraints;
a smaller one would refuse lengths that are written with ten digits."""


@effect_class
class Effect(ABC):
    """Base class of effects: a function, the bodies that it depends on, and its parameters.

    An effect has one or more *elements*, and an element has a body in each *role*: ``Spring([("hub", "tip"), ("tip", "load")], 1.0)`` has
    two elements; "hub" and "tip" have the role a in them, "tip" and "load" the role b. The signature of its function depends on `kind`:

    | kind | function | returns |
    |---|---|---|
    | "potential" | ``function(q, params)`` | energy, () |
    | "constraint" | ``function(q, params)``, `timed` ``function(t, q, params)`` | values that the scene keeps zero, (k,) or () for each element |
    | "kinetic" | ``function(q, v, params)`` | energy added to ``sum m v^2 / 2``, () |
    | "force" | ``function(t, q, v, params)`` | tuple of forces, shaped like q |
    | "control" | ``function(q, u, params)`` | tuple of forces of the controls u, shaped like q |

    q and v are tuples with an entry for each role: the coordinates (d,) of its body or, with n > 1 elements, (n, d). A rigid body
    enters with the coordinates of its centre, or of the point in ``(name, [x, y, z])``. The ground is a body, too. params
    holds the fields that a class declares as numbers, vectors or arrays (see `vmri_jax.scene.declare`), by name.

    The argument `bodies` of the methods holds all bodies of the scene by name.

    Args:
        name: of this effect in its scene; by default `default_name` of its class, or the name of the class in small letters.
        rate: how often a potential is evaluated: "slow" (as part of V), "fast" (on the micro grid, with the rule of W), a whole number k
            (on every k-th micro node), or "auto" (the scene decides by stiffness). A potential with the rate "fast" or k makes its bodies fast, except bodies
            with the pace "slow": the positions of these slow bodies are then solved for by iteration over the macro step. Of a kinetic effect "slow",
            "fast" or "auto"; here the rate decides only whether its bodies are fast, since all kinetic effects are on the micro grid.
    """

    kind: ClassVar[Kind]
    function: ClassVar[Any]
    rest: ClassVar[Any] = None
    """``rest(q, params) -> ()``: the value of a `measured` parameter of a single element at the start."""
    default_name: ClassVar[str] = ""
    timed: ClassVar[bool] = False
    """Whether a constraint depends on time."""
    dimensions: ClassVar[tuple[int, ...]] = ()
    """The effect is between points of one of these dimensions; () also allows blocks of general coordinates."""
    same_size: ClassVar[bool] = True
    """Whether all bodies of an element must have the same dimension."""
    apart: ClassVar[bool] = False
    """Whether neighbouring bodies of an element, or a body and the fixed point it is tied to, must start at different places."""
    masses: ClassVar[tuple[str, ...]] = ()
    """Names of parameters that hold the masses of the bodies, one for each role."""
    derived: ClassVar[tuple[str, ...]] = ()
    """Names of parameters that are computed from fields and bodies, and have an entry for each element."""
    whole: ClassVar[bool] = False
    """Whether the function gets all coordinates of a rigid body instead of the coordinates of its centre."""
    drawn_as: ClassVar[Literal["link", "spring"] | None] = None
    """The symbol that is drawn between neighbouring bodies of an element."""

    name: str = field(default="", kw_only=True)
    rate: Literal["slow", "fast", "auto"] | int = field(default="auto", kw_only=True)

    def __new__(cls, *args, **kwargs):
        """A new effect, of a class that is complete.

        Raises:
            TypeError: the class has no decorator, no `kind`, no field with names of bodies, or a `function` that would get the effect itself.
        """
        about = f"the class of effects {cls.__name__}"
        if any(isinstance(value, Field) for value in vars(cls).values()):  # the decorator replaces them
            raise TypeError(f"{about} has no decorator; write @effect_class of vmri_jax.scene.declare above it.")
        if getattr(cls, "kind", None) not in get_args(Kind):
            raise TypeError(f"{about} has no kind; write kind = one of {', '.join(map(repr, get_args(Kind)))} in it.")
        if cls.elements is Effect.elements and not any("names" in f.metadata for f in fields(cls)):
            raise TypeError(
                f"{about} has no field with names of bodies; declare one, bodies: Any = names(2) for pairs."
            )
        if isfunction(getattr_static(cls, "function", None)):
            raise TypeError(
                f"{about} has a function without @staticmethod; write it above the function, which gets no self."
            )
        return super().__new__(cls)

    def __post_init__(self):
        if not self.name:
            object.__setattr__(self, "name", self.default_name or type(self).__name__.lower())
        for argument in fields(self):
            about, value = f"{self.name}: {argument.name}", lasting(getattr(self, argument.name))
            object.__setattr__(self, argument.name, value)
            if "of_time" in argument.metadata:
                if not callable(value):
                    raise TypeError(f"{about} is {value!r}; give a function of (t, params).")
                check_arguments(about, value, "t, params")
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
        """Names of parameters that have an entry for each element, or a single number for all."""
        declared = [name for name, parameter in self.declared.items() if parameter.shape in ("number", "vector")]
        return (*declared, *self.masses, *self.derived, *POINTS)

    def bound(self, effects: Sequence["Effect"]) -> "Effect":
        """A copy in which names of other effects, such as joints, are replaced by these effects.

        Raises:
            ValueError: a name that no such effect has.
        """
        return self

    def elements(self, bodies: Bodies) -> Elements:
        """Names of the bodies of every element."""
        names = next(f for f in fields(self) if "names" in f.metadata)
        return names.metadata["names"].elements(getattr(self, names.name), bodies, f"{self.name}: {names.name}")

    def parameters(self, bodies: Bodies) -> dict[str, Any]:
        """The params of the function: arrays by name."""
        params, elements = {}, self.elements(bodies)
        firsts = [end_of(bodies, element[0], self.whole) for element in elements]
        for name, parameter in self.declared.items():
            if getattr(self, name) is not None:
                params[name] = parameter.array(f"{self.name}: {name}", getattr(self, name), firsts)
        for argument in fields(self):
            if "of_time" in argument.metadata:
                params[argument.name] = real_tree(f"{self.name}: params", vars(self)["params"])
        for role, name in enumerate(self.masses):
            params[name] = squeeze(jnp.stack([self._mass(element[role], bodies) for element in elements]))
        params |= self.points(bodies)
        for name, parameter in self.declared.items():
            if parameter.measured and name not in params:
                params[name] = self.at_start(bodies, params)
        return params

    def points(self, bodies: Bodies) -> dict[str, Any]:
        """For each role with points fixed in rigid bodies, the components X of these points along the directors; zeros for whole bodies."""
        points = {}
        for parameter, role in zip(POINTS, zip(*self.elements(bodies), strict=True), strict=False):
            if any(isinstance(name, Attachment) for name in role):
                components = [
                    body_of(bodies, name).weights(name.offset) if isinstance(name, Attachment) else np.zeros(3)
                    for name in role
                ]
                points[parameter] = squeeze(jnp.stack(components))
        return points

    def at_start(self, bodies: Bodies, params: dict[str, Any]):
        """The measured value of every element at the start, (n,), or () of a single element."""
        count = len(self.elements(bodies))
        return squeeze(jnp.stack([self.rest(*self.element_arguments(i, bodies, params)) for i in range(count)]))

    def element_arguments(self, i: int, bodies: Bodies, params: dict[str, Any]) -> tuple[tuple, dict[str, Any]]:
        """The arguments (q, params) of the function for element i at the start, from the params of all elements."""
        q = tuple(end_of(bodies, name, self.whole).position for name in self.elements(bodies)[i])
        return q, self._element_params(i, bodies, params)

    def element_term(
        self, i: int, bodies: Bodies, params: dict[str, Any], freedoms: Sequence[Key] = ()
    ) -> tuple[EffectTerm, dict[str, Any]]:
        """Element i as a term of the coordinates of its moving bodies, one after the other, and its part of the params of all elements.

        The term takes these coordinates, followed by `freedoms` that are coordinates of the scene, as q_s, and no q_f.
        """
        places, end = {}, 0
        for name in moving(self.elements(bodies)[i]):
            places[name] = Place("s", end, bodies[name].size)
            end += bodies[name].size
        of_freedoms = {key: Place("s", end + k, 1) for k, key in enumerate(freedoms)}
        (term,) = self.terms((i,), bodies, Layout(places, {}, of_freedoms), {})
        # without the name and number of the element, equal terms share a compiled program
        return replace(term, name=ALONE, select=None), {ALONE: self._element_params(i, bodies, params)}

    def freedoms_of(self, i: int) -> tuple[Key, ...]:
        """The freedoms of joints that element i is a function of; () if it depends on other coordinates."""
        return ()

    def _element_params(self, i: int, bodies: Bodies, params: dict[str, Any]) -> dict[str, Any]:
        """Parameters of element i, taken from the parameters of all elements."""
        return params if len(self.elements(bodies)) == 1 else choose(params, (i,), self.split)

    def check(self, bodies: Bodies, moved: bool = False) -> None:
        """Refuse bodies and parameters that do not fit this effect.

        Args:
            moved: whether the scene moves the bodies onto the constraints later, so that these may be violated now.

        Raises:
            TypeError: parameters that are no real numbers.
            ValueError: unknown bodies, a body twice in one element, bodies of different dimension, at one point, or of
                general coordinates where points are needed; parameters of another shape, sign or precision, and arguments that
                the class of the effect forbids.
        """
        self.check_bodies(bodies)
        self.check_parameters(bodies)
        check_function(self, bodies, moved)
        if self.kind == "constraint" and not moved:
            self.check_start(bodies)

    def check_bodies(self, bodies: Bodies) -> None:
        """Refuse names of no body, and bodies whose coordinates the function cannot take."""
        elements = self.elements(bodies)
        for element in elements:
            if len(element) > MOST_ROLES:
                raise ValueError(
                    f"{self.name}: an element of {len(element)} bodies, {', '.join(map(str, element[:3]))}, ...; at most {MOST_ROLES} bodies "
                    "may share a function. Write the function with vmri_jax.System, or join bodies to one with more coordinates."
                )
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
                if self.dimensions and (end.block or end.size not in self.dimensions):
                    general, allowed = "general " if end.block else "", " or ".join(map(str, self.dimensions))
                    raise ValueError(
                        f"{self.name}: {name} has {end.size} {general}coordinates; this effect is between points of dimension {allowed}."
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
            value = getattr(self, name)
            if parameter.sign and value is not None and is_concrete(value):
                value = np.asarray(value, dtype=float)
                fits = value > 0 if parameter.sign == "positive" else value >= 0
                self.require(fits, name, value, f"it must be {parameter.sign}")

    def by_size(self, select: Sequence[int], bodies: Bodies) -> list[list[int]]:
        """Elements, by their numbers, in groups between bodies of the same sizes and kinds: each group is a term."""
        elements, groups = self.elements(bodies), {}
        for i in select:
            ends = [(name, end_of(bodies, name, self.whole).size) for name in elements[i]]
            kinds = ((name == GROUND, isinstance(name, Attachment), body_of(bodies, name).size, n) for name, n in ends)
            groups.setdefault(tuple(kinds), []).append(i)
        return list(groups.values())

    def terms(self, select: Sequence[int], bodies: Bodies, layout: Layout, potentials: Mapping[str, Any]):
        """The terms of some elements, one for each group `by_size`; `potentials` has all their terms by name."""
        elements, terms = self.elements(bodies), []
        for group in self.by_size(select, bodies):
            names = zip(POINTS, zip(*(elements[i] for i in group), strict=True), strict=False)
            roles = tuple(self._role(parameter, role, bodies, layout.bodies) for parameter, role in names)
            numbers = None if len(group) == len(elements) else tuple(group)
            terms.append(EffectTerm(self.name, self.function, roles, numbers, self.split, self.timed))
        return tuple(terms)

    def _role(self, parameter: str, names: Sequence[str], bodies: Bodies, places: Mapping[str, Place]) -> Role:
        """The map from q_s and q_f to the coordinates of the bodies of a role, all of the same kind, or to points in them, which are a parameter."""
        size, attached = end_of(bodies, names[0], self.whole).size, isinstance(names[0], Attachment)
        if names[0] == GROUND:
            return OnGround(len(names), size, parameter if attached else None)
        of_bodies = [places[name] for name in names]
        return InRigidBodies(Rows.of(of_bodies), parameter) if attached else OnBodies(Rows.of(of_bodies, size))

    def components(self, bodies: Bodies) -> tuple[str, ...]:
        """Names of the controls of this effect; () unless its kind is "control"."""
        return ()

    def curvature(self, bodies: Bodies):
        """Largest second derivative of the energy of each element, () or (n,), if the start does not show it (contacts that are open); else None."""
        return None

    def drawn_points(self, bodies: Bodies) -> dict[str, tuple[str, Any]]:
        """Points in rigid bodies where a drawn link or spring ends: their labels, with the body and the components of the point in it."""
        if self.drawn_as is None:
            return {}
        names = [name for element in self.elements(bodies) for name in element]
        return {
            name.label: (str(name), bodies[name].weights(name.offset))
            for name in names
            if isinstance(name, Attachment) and name != GROUND
        }

    def drawing(self, bodies: Bodies) -> dict[str, list]:
        """Entries of this effect in the lists of `Scene.drawing`, and "radii" of bodies as pairs (name, number)."""
        if self.drawn_as is None:
            return {}
        pairs = [pair for element in self.elements(bodies) for pair in pairwise(element)]
        between = [[label_of(a), label_of(b)] for a, b in pairs if GROUND not in (a, b)]
        to_ground = [(a, b) if b == GROUND else (b, a) for a, b in pairs if GROUND in (a, b)]
        anchors = [
            {"body": label_of(body), "point": end_of(bodies, ground).position.tolist(), "kind": self.drawn_as}
            for body, ground in to_ground
        ]
        return {DRAWN[self.drawn_as]: between, "anchors": anchors}

    def require(self, condition: Any, quantity: str, value: Any, expected: str) -> None:
        """Raise ValueError, "{quantity} is {value}; {expected}.", unless a condition is true everywhere, or traced."""
        if is_concrete(condition) and not np.all(condition):
            shown = np.asarray(value) if is_concrete(value) else value
            raise ValueError(f"{self.name}: {quantity} is {shown}; {expected}.")

    def require_apart(self, bodies: Bodies) -> None:
        """Refuse elements whose neighbouring bodies are at the same point at the start."""
        for a, b in (pair for element in self.elements(bodies) for pair in pairwise(element)):
            distance = jnp.sqrt(jnp.sum((end_of(bodies, b).position - end_of(bodies, a).position) ** 2))
            expected = "they must not start at the same point; move one of them"
            self.require(distance > 0, f"the distance of {a} and {b}", distance, expected)

    def _mass(self, name: str, bodies: Bodies):
        """The mass () of a body, refused if it has none or several."""
        mass = end_of(bodies, name).mass
        if mass is None:
            raise ValueError(
                f"{self.name}: {label_of(name)} has no mass; this effect needs the mass of a whole body. Name a body with mass, without a point."
            )
        if mass.ndim:
            raise ValueError(
                f"{self.name}: {name} has a mass for each coordinate; this effect needs one mass for each body. Leave this body out, or give it one mass."
            )
        return mass

    def _check_sizes(self, names: Sequence[str], bodies: Bodies) -> None:
        sizes = {name: end_of(bodies, name, self.whole).size for name in names}
        if len(set(sizes.values())) > 1:
            described = ", ".join(f"{name} {size}" for name, size in sizes.items())
            raise ValueError(f"{self.name}: bodies of different dimension ({described}); they must have the same.")

    def check_start(self, bodies: Bodies) -> None:
        """Refuse a constraint that the start violates, such as a link whose length is not the distance of its ends."""
        for name in (name for name, parameter in self.declared.items() if parameter.measured):
            params = self.parameters(bodies)
            start = self.at_start(bodies, params)
            if getattr(self, name) is None or not is_concrete((params[name], start)):
                continue
            values = np.broadcast_arrays(np.atleast_1d(params[name]), start)
            for element, kept, measured in zip(self.elements(bodies), *values, strict=True):
                agrees = abs(kept - measured) <= START * kept
                expected = (
                    f"it starts as {measured:.12g}; give this value, move a body, or let the scene do so, project=True"
                )
                self.require(agrees, f"{name} of {'-'.join(map(label_of, element))}", f"{kept:g}", expected)

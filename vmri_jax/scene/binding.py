"""Binding of effects to the bodies of a scene: elements, parameters, values at the start, and terms are computed once.

And the places of all coordinates.
"""

from abc import ABC
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, ClassVar, Literal, NamedTuple, Self

import numpy as np

from vmri_jax.mechanics.arrays import library
from vmri_jax.mechanics.kinematics import SIZE, Kinematics
from vmri_jax.mechanics.rows import Place, Rows
from vmri_jax.mechanics.slots import Computed
from vmri_jax.refusals import Refused
from vmri_jax.scene.body import GROUND, Attachment, Bodies, Point, body_of, end_of, label_of, moving, weights_of
from vmri_jax.scene.declare import Declared, Elements, Parameter, real_tree, stacked
from vmri_jax.scene.terms import ARGUMENTS, Applied, EffectTerm, Role, Source, choose, is_of_package

MOST_ROLES = 32
"""Most bodies of an element: the two bodies of each of sixteen joints that one equation couples. More are refused."""
POINTS = tuple(f"at_{role}" for role in range(MOST_ROLES))
"""Names of the parameters that hold points fixed in rigid bodies, one for each role."""
ALONE = "alone"
"""Name of the term of a single element, the same for all effects, so that equal functions share a compiled program."""


Key = tuple[str, int, str]
"""Name of a joint, number of its pair of bodies, and name of a freedom of the joint."""


class DecidedPace(NamedTuple):
    """Whether a body is slow or fast, and why."""

    value: Literal["slow", "fast"]
    reason: str


@dataclass(frozen=True)
class Layout:
    """Places of the coordinates q of the scene and of the coordinates Q of its bodies.

    Attributes:
        bodies: by name of the body, the place in Q_s or Q_f of its coordinates as a point or rigid body, see
            `Kinematics`. A body that is no function of joint coordinates has the same place in q_s or q_f.
        coordinates: by name, the place in q_s or q_f of the coordinates of a body or of a freedom of a joint.
        freedoms: places of the freedoms of joints in q_s or q_f.
        kinematics: the map from q to Q; None if Q = q.
    """

    bodies: dict[str, Place]
    coordinates: dict[str, Place]
    freedoms: dict[Key, Place] = field(default_factory=dict)
    kinematics: Kinematics | None = None

    @property
    def sizes(self) -> tuple[int, int]:
        """(n_s, n_f)."""
        return _ends([*self.coordinates.values()])

    @property
    def ends(self) -> tuple[int, int]:
        """Lengths of Q_s and Q_f."""
        return _ends([*self.coordinates.values(), *self.bodies.values()])

    def of(self, names: Collection[str]) -> "Layout":
        """The layout of functions of some bodies alone, and of the bodies on joints between them in the order of the
        kinematics."""
        if self.kinematics is None:
            return self
        carried = sorted(self.bodies.keys() - self.coordinates.keys(), key=lambda name: self.bodies[name].order)
        numbers = [i for i, name in enumerate(carried) if name in names]
        first, end = min(numbers, default=0), max(numbers, default=-1) + 1
        kinematics, ends = self.kinematics.of(first, end), dict(zip("sf", self.sizes, strict=True))
        bodies = {name: place for name, place in self.bodies.items() if name in self.coordinates}
        for name, body in zip(carried[first:end], kinematics.bodies, strict=True):
            bodies[name] = Place(body.part, ends[body.part], SIZE)
            ends[body.part] += SIZE
        return replace(self, bodies=bodies, kinematics=kinematics)

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """Numbers of the coordinates of every body in (Q_s, Q_f), taken as one vector."""
        num_slow = self.ends[0]
        return {name: place.numbers(num_slow) for name, place in self.bodies.items()}

    @property
    def numbers(self) -> dict[str | Key, np.ndarray]:
        """Numbers of the coordinates of every name and freedom in (q_s, q_f), taken as one vector."""
        num_slow, places = self.sizes[0], {**self.coordinates, **self.freedoms}
        return {name: place.numbers(num_slow) for name, place in places.items()}


def _ends(places: Sequence[Place]) -> tuple[int, int]:
    slow, fast = (max((p.start + p.size for p in places if p.part == part), default=0) for part in ("s", "f"))
    return slow, fast


class Bindable(Declared, ABC):
    """An effect with the bodies of its scene; see `vmri_jax.scene.effect.Effect` for the attributes of its class.

    What depends on bodies is known of bound effects alone, see `bound`.
    """

    kind: ClassVar[Any]
    function: ClassVar[Any]
    rest: ClassVar[Any] = None
    """``rest(q, params) -> (n,)``: the values of a `measured` parameter of n elements at the start; () of a single
    element."""
    timed: ClassVar[bool] = False
    """Whether a constraint depends on time."""
    is_analytic: ClassVar[bool] = False
    """Whether the function is an analytic function of the coordinates, and takes complex arrays of NumPy: its
    derivatives need no program."""
    masses: ClassVar[tuple[str, ...]] = ()
    """Names of parameters that hold the masses of the bodies, one for each role."""
    derived: ClassVar[tuple[str, ...]] = ()
    """Names of parameters that are computed from fields and bodies, and have an entry for each element.

    As `masses`, they are `Computed`.
    """
    whole: ClassVar[bool] = False
    """Whether the function gets all coordinates of a rigid body instead of the coordinates of its centre."""
    name: str = field(default="", kw_only=True)
    rate: Literal["slow", "fast", "auto"] | int = field(default="auto", kw_only=True)

    @property
    def declared(self) -> dict[str, Parameter]:
        """The declared parameters by name."""
        return {f.name: f.metadata["parameter"] for f in fields(self) if "parameter" in f.metadata}

    def bound(self, bodies: Bodies) -> Self:
        """A copy that knows the bodies of its scene; the effect itself if it knows these bodies already."""
        if vars(self).get("_by_name") is bodies:
            return self
        copied = replace(self)
        vars(copied)["_by_name"] = bodies
        return copied

    def resolved(self, effects: Sequence[Any]) -> Any:
        """A copy in which names of other effects, such as joints, are replaced by these effects, which are bound.

        Raises:
            ValueError: a name that no such effect has.
        """
        return self

    @property
    def by_name(self) -> Bodies:
        """All bodies of the scene by name."""
        return vars(self)["_by_name"]

    @property
    def called(self) -> Any:
        """The function that terms call; the functions of time of the user are its first arguments, see `of_time`."""
        of_time = tuple(self.functions_of_time.values())
        return Applied(self.function, of_time) if of_time else self.function

    @property
    def functions_of_time(self) -> dict[str, Any]:
        """The functions of time of the user by the names of their fields."""
        return {f.name: getattr(self, f.name) for f in fields(self) if "of_time" in f.metadata}

    @property
    def params_of_time(self) -> Any:
        """The params of the functions of time."""
        return real_tree(f"{self.name}: params", vars(self)["params"])

    @property
    def arguments(self) -> tuple[str, ...]:
        """Names of the arguments of the function before params."""
        of_kind = ARGUMENTS[self.kind]
        return ("t", *of_kind) if self.timed and "t" not in of_kind else of_kind

    @cached_property
    def elements(self) -> Elements:
        """Names of the bodies of every element."""
        return self._elements()

    @cached_property
    def parameters(self) -> dict[str, Any]:
        """The params of the function: arrays by name; of NumPy unless an entry is traced."""
        params = self._parameters()
        copies = {name: Computed(name) for name in (*self.masses, *self.derived)} if isinstance(params, dict) else {}
        return {copies.get(name, name): value for name, value in params.items()} if copies else params

    @cached_property
    def ends(self) -> tuple[tuple[Point, ...], ...]:
        """The points at the start that the function gets for every element, one for each role."""
        return tuple(tuple(end_of(self.by_name, name, self.whole) for name in element) for element in self.attached)

    @cached_property
    def attached(self) -> Elements:
        """Names of the bodies whose coordinates the function gets for every element, one for each role: those of
        `elements`."""
        return self.elements

    def _elements(self) -> Elements:
        """See `elements`."""
        names = next(f for f in fields(self) if "names" in f.metadata)
        argument, about = getattr(self, names.name), f"{self.name}: {names.name}"
        return names.metadata["names"].elements(argument, self.by_name, about)

    def _parameters(self) -> dict[str, Any]:
        """See `parameters`."""
        params, firsts = {}, [ends[0] for ends in self.ends]
        for name, parameter in self.declared.items():
            if getattr(self, name) is not None:
                params[name] = parameter.array(f"{self.name}: {name}", getattr(self, name), firsts)
        if self.functions_of_time:
            params |= dict.fromkeys(self.functions_of_time, self.params_of_time)
        for role, name in enumerate(self.masses):
            params[name] = stacked([self._mass(element[role]) for element in self.elements])
        params |= self.points
        for name, parameter in self.declared.items():
            if parameter.measured and name not in params:
                params[name] = self.at_start(params)
        return params

    def _mass(self, name: str):
        """The mass () of a body, refused if it has none or several."""
        mass = end_of(self.by_name, name).mass
        if mass is None:
            raise Refused(
                f"{self.name}: {label_of(name)} has no mass; this effect needs the mass of a whole body. Name a body "
                "with mass, without a point."
            )
        if mass.ndim:
            raise Refused(
                f"{self.name}: {name} has a mass for each coordinate; this effect needs one mass for each body. Leave "
                "this body out, or give it one mass."
            )
        return mass

    @cached_property
    def points(self) -> dict[str, Any]:
        """For each role with points fixed in rigid bodies, the components X of these points along the directors; zeros
        for whole bodies."""
        points = {}
        for parameter, role in zip(POINTS, zip(*self.elements, strict=True), strict=False):
            if any(isinstance(name, Attachment) for name in role):
                points[parameter] = stacked([weights_of(self.by_name, name) for name in role])
        return points

    def at_start(self, params: Mapping[str, Any]):
        """The measured value of every element at the start, (n,), or () of a single element."""
        values: dict[int, Any] = {}
        for group in self.groups():
            of_group = self.rest(self.positions(group), self.params_of(group, params))
            values |= zip(group, library(of_group).atleast_1d(of_group), strict=True)
        return stacked([values[i] for i in sorted(values)])

    def positions(self, group: Sequence[int]) -> tuple[Any, ...]:
        """The argument q of the function for elements of the same size at the start."""
        roles = zip(*(self.ends[i] for i in group), strict=True)
        return tuple(stacked([end.position for end in role]) for role in roles)

    def arguments_at_start(self, group: Sequence[int]) -> list[Any]:
        """The arguments of the function for elements of the same size at the start, at rest."""
        q = self.positions(group)
        values = {"t": np.zeros(()), "q": q, "v": tuple(np.zeros(x.shape) for x in q)}
        return [*map(values.get, self.arguments), self.params_of(group)]

    def params_of(self, group: Sequence[int], params: Any = None) -> Any:
        """The argument params of the function for some elements, from the `params` of all elements."""
        params = self.parameters if params is None else params
        return params if len(self.elements) == len(group) else choose(params, group, self.split_of(params))

    def split_of(self, params: Any) -> tuple[str, ...]:
        """Names in params that have an entry for each element, or a single number for all; none in a tree of a user
        that is no dictionary."""
        declared = [name for name, parameter in self.declared.items() if parameter.shape in ("number", "vector")]
        names = (*declared, *self.masses, *self.derived, *POINTS) if isinstance(params, dict) else ()
        return tuple(name for name in names if name in params)

    def element_term(self, i: int) -> tuple[EffectTerm, dict[str, Any]]:
        """Element i as a term of the coordinates of its moving bodies, one after the other, and its part of the params
        of all elements.

        The term takes these coordinates as q_s, and no q_f.
        """
        places, end = {}, 0
        for name in moving(self.elements[i]):
            places[name] = Place("s", end, self.by_name[name].size)
            end += self.by_name[name].size
        (term,) = self.terms((i,), Layout(places, {}))
        # without the name and number of the element, equal terms share a compiled program
        return replace(term, sources=(Source(ALONE, 1),)), {ALONE: self.params_of((i,))}

    def freedoms_of(self, i: int) -> tuple[Key, ...]:
        """The freedoms of joints that element i is a function of; () if it depends on other coordinates."""
        return ()

    def kind_of(self, i: int, layout: Layout | None = None) -> tuple:
        """Equal for elements that can be one term: between bodies of the same sizes and kinds."""
        return tuple(
            (name == GROUND, isinstance(name, Attachment), body_of(self.by_name, name).size, end.size)
            for name, end in zip(self.attached[i], self.ends[i], strict=True)
        )

    def groups(self, select: Sequence[int] | None = None, layout: Layout | None = None) -> list[list[int]]:
        """Some or all elements, by their numbers, in groups of one kind."""
        groups: dict[tuple, list[int]] = {}
        for i in range(len(self.elements)) if select is None else select:
            groups.setdefault(self.kind_of(i, layout), []).append(i)
        return list(groups.values())

    def terms(self, select: Sequence[int], layout: Layout) -> tuple:
        """The terms of some elements, one for each group."""
        return tuple(self.term(group, layout) for group in self.groups(select, layout))

    def term(self, group: Sequence[int], layout: Layout) -> EffectTerm:
        """The term of elements of one kind."""
        roles = zip(POINTS, zip(*(self.attached[i] for i in group), strict=True), strict=False)
        return self._term([self._role(*role, layout.bodies) for role in roles], group)

    def _term(
        self, roles: Iterable[Role], group: Sequence[int], through: Any = None, unused: Sequence[str] = ()
    ) -> EffectTerm:
        """Some elements as a term, whose function does not use the parameters `unused`."""
        select = None if len(group) == len(self.elements) else tuple(group)
        split = tuple(name for name in self.split_of(self.parameters) if name not in unused)
        # A function of the user may be right for a single element alone; no parameter may be common to all elements.
        is_joined = is_of_package(self.called) and not self.parameters.keys() - {*split, *unused}
        sources, of_kinds = (Source(self.name, len(group), select),), tuple((role,) for role in roles)
        return EffectTerm(sources, self.called, self.arguments, of_kinds, split, is_joined, through)

    def _role(self, parameter: str, names: Sequence[str], places: Mapping[str, Place]) -> Role:
        """The map from q_s and q_f to the coordinates of the bodies of a role, all of the same kind, or to points in
        them, which are a parameter."""
        size = end_of(self.by_name, names[0], self.whole).size
        point = parameter if isinstance(names[0], Attachment) else ""
        rows = None if names[0] == GROUND else Rows.of([places[name] for name in names], None if point else size)
        return Role(rows, len(names), size, point)


def bound(effects: Sequence[Any], bodies: Bodies) -> tuple[Any, ...]:
    """The effects on the bodies of a scene, with bound effects in place of their names."""
    on_bodies = [effect.bound(bodies) for effect in effects]
    return tuple(effect.resolved(on_bodies).bound(bodies) for effect in on_bodies)

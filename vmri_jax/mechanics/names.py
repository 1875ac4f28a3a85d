"""Names of coordinates, bodies and constraints: for labels, files, and access to quantities by name."""

import difflib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from vmri_jax.mechanics.by_name import Layout
from vmri_jax.mechanics.kinematics import Kinematics
from vmri_jax.mechanics.rows import Part, Place
from vmri_jax.mechanics.system import System
from vmri_jax.refusals import Refused

AXES = "xyz"
"""Coordinates of a point of two or three dimensions."""


@dataclass(frozen=True)
class Names:
    """Names and sizes of the bodies in q_s and q_f, and of the constraints in the values of the constraint functions, in order.

        Names(slow={"trolley": 1}, fast={"hook": 2, "load": 2}, constraint={"rope": 1})

    Args:
        slow, fast: bodies, or single coordinates, in the order of q_s and q_f, with their numbers of coordinates.
        constraint, slow_constraint: constraints in the order of the values of these functions, with their numbers of rows.
        numbered: bodies with generalised coordinates: these have the names "name[0]", "name[1]", not "name x", "name y".
        rigid: bodies whose coordinates are a centre and directors: "name x", "name y", "name z", "name d1 x" and so on.
        carried: places in Q_s and Q_f of the bodies that are functions of the coordinates, by name.
        kinematics: the map from q_s, q_f to Q_s, Q_f, see `vmri_jax.mechanics.kinematics`; None without such bodies.
        angles: coordinates of `slow` and `fast` that are angles, rad.
        layouts: of q_s and of q_f if the user gave dictionaries of arrays, None for vectors; a run returns its positions in the same form.

    Raises:
        TypeError: an argument that is no mapping from names to whole numbers.
        ValueError: a body that is slow and fast.
    """

    slow: Mapping[str, int] = field(default_factory=dict)
    fast: Mapping[str, int] = field(default_factory=dict)
    constraint: Mapping[str, int] = field(default_factory=dict)
    slow_constraint: Mapping[str, int] = field(default_factory=dict)
    numbered: Sequence[str] = ()
    rigid: Sequence[str] = ()
    carried: Mapping[str, Place] = field(default_factory=dict)
    kinematics: Kinematics | None = None
    layouts: tuple[Layout | None, Layout | None] = (None, None)
    angles: Sequence[str] = ()

    def __hash__(self) -> int:
        return hash((*map(tuple, (self.slow, self.fast, self.constraint, self.slow_constraint)), self.layouts))

    def __post_init__(self):
        for field_name in ("slow", "fast", "constraint", "slow_constraint"):
            sizes = getattr(self, field_name)
            named = isinstance(sizes, Mapping) and all(isinstance(name, str) for name in sizes)
            if not (named and all(isinstance(size, int) and size > 0 for size in sizes.values())):
                raise Refused(
                    f"Names: {field_name} is {sizes!r}; give a dictionary of names and sizes in the order of the coordinates or "
                    "rows, e.g. {'hook': 2, 'load': 2}."
                )
        both = sorted(set(self.slow) & set(self.fast))
        if both:
            raise Refused(f"Names: {', '.join(both)} in slow and in fast; give every body one place.")

    @property
    def bodies(self) -> dict[str, Place]:
        """The place of every body."""
        parts: list[tuple[Part, Mapping[str, int]]] = [("s", self.slow), ("f", self.fast)]
        return {
            name: Place(part, start, size) for part, sizes in parts for name, start, size in _one_after_another(sizes)
        }

    def shaped(self, part: Part, vectors) -> Any:
        """Vectors (..., n) in the form of the start: a dictionary of arrays by name, or the vectors themselves."""
        layout = self.layouts[part == "f"]
        return vectors if layout is None else layout.by_name(vectors)

    @property
    def slow_coordinates(self) -> list[str]:
        """A name for each entry of q_s."""
        return self._coordinates(self.slow)

    @property
    def fast_coordinates(self) -> list[str]:
        """A name for each entry of q_f."""
        return self._coordinates(self.fast)

    def positions(self, part: Part) -> list[int]:
        """Indices of positions in q_s or q_f: of all entries but the directors of rigid bodies."""
        indices = []
        for name, place in self.bodies.items():
            if place.part == part:
                indices += range(place.start, place.start + (len(AXES) if name in self.rigid else place.size))
        return indices

    @property
    def rows(self) -> dict[str, list[int]]:
        """Indices of the values of every constraint among the values of `constraint` followed by `slow_constraint`."""
        rows: dict[str, list[int]] = {}
        total = sum(self.constraint.values())
        for first, sizes in ((0, self.constraint), (total, self.slow_constraint)):
            for name, start, size in _one_after_another(sizes):
                rows.setdefault(name, []).extend(range(first + start, first + start + size))
        return rows

    def place(self, body: str) -> Place:
        """The place of a body.

        Raises:
            ValueError: no body of this name.
        """
        if body not in self.bodies:
            raise Refused(unknown("body", body, {**self.bodies, **self.carried}))
        return self.bodies[body]

    def place_of(self, body: str) -> Place:
        """The place of a body in (Q_s, Q_f) of the kinematics, or as `place`.

        Raises:
            ValueError: no body of this name.
        """
        return self.carried[body] if body in self.carried else self.place(body)

    def of(self, system: System, n_s: int, n_f: int) -> "Names":
        """These names, completed by plain names for coordinates and constraints of a system without a name.

        Raises:
            ValueError: sizes that do not add up to the numbers of coordinates and of constraint rows.
        """
        n_g, n_gs = system.num_constraints(np.zeros(n_s), np.zeros(n_f))
        constraint = self._completed("constraint", "constraint", n_g)
        slow_constraint = self._completed("slow_constraint", "slow_constraint", n_gs)
        return replace(self.of_coordinates(n_s, n_f), constraint=constraint, slow_constraint=slow_constraint)

    def of_coordinates(self, n_s: int, n_f: int) -> "Names":
        """These names, completed by plain names for coordinates without a name.

        Raises:
            ValueError: sizes that do not add up to these numbers.
        """
        slow, fast = self._completed("slow", "q_s", n_s), self._completed("fast", "q_f", n_f)
        return replace(self, slow=slow, fast=fast, numbered=(*self.numbered, "q_s", "q_f"))

    def _completed(self, field_name: str, plain: str, number: int) -> dict[str, int]:
        sizes = dict(getattr(self, field_name)) or ({plain: number} if number else {})
        if sum(sizes.values()) != number:
            raise Refused(
                f"Names: {field_name} is {sizes}, which names {sum(sizes.values())}; the system has {number}. The sizes must add up "
                "to that."
            )
        return sizes

    def _coordinates(self, sizes: Mapping[str, int]) -> list[str]:
        names, shapes = [], {name: shape for layout in self.layouts if layout for name, shape in layout.shapes}
        for name, size in sizes.items():
            *rows, columns = shapes.get(name, (size,)) or (1,)
            # entries of an array of points, e.g. of atoms, are called "atoms[3] x"; of other arrays "name[i,j]"
            if rows:
                are_points = columns <= len(AXES)
                for index in np.ndindex(*rows, *([] if are_points else [columns])):
                    entry = f"{name}[{','.join(map(str, index))}]"
                    names += [f"{entry} {axis}" for axis in AXES[:columns]] if are_points else [entry]
            elif name in self.rigid:
                parts = [name, *(f"{name} d{i}" for i in range(1, size // len(AXES)))]
                names += [f"{part} {axis}" for part in parts for axis in AXES]
            elif name in self.numbered or size > len(AXES):
                names += [f"{name}[{i}]" for i in range(size)]
            elif size == 1:
                names.append(name)
            else:
                names += [f"{name} {axis}" for axis in AXES[:size]]
        return names

    def to_dict(self) -> dict[str, Any]:
        """As plain data for JSON, in the same order."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> "Names":
        """The inverse of `to_dict`, also after a round trip through JSON; absent fields have their defaults."""
        fields = dict(data)
        fields["carried"] = {name: Place(*place) for name, place in data.get("carried", {}).items()}
        if data.get("kinematics") is not None:
            fields["kinematics"] = Kinematics.from_dict(data["kinematics"])
        layouts = data.get("layouts", (None, None))
        fields["layouts"] = tuple(None if layout is None else Layout.from_dict(layout) for layout in layouts)
        return cls(**fields)


def unknown(kind: str, name: Any, known: Iterable[str]) -> str:
    """The sentence that a name is unknown, with the most similar known name.

    Args:
        kind: of the objects with names, e.g. "body".
    """
    known = list(known)
    return f"there is no {kind} {name!r}.{near(name, known)} There are {', '.join(known) or 'none'}."


def near(name: Any, known: Iterable[str]) -> str:
    """A question with the most similar known name; empty if no name is similar."""
    close = difflib.get_close_matches(str(name), list(known), n=1)
    return f" Did you mean {close[0]}?" if close else ""


def _one_after_another(sizes: Mapping[str, int]) -> list[tuple[str, int, int]]:
    """(name, start, size) of every entry, one after the other."""
    starts, end = [], 0
    for name, size in sizes.items():
        starts.append((name, end, size))
        end += size
    return starts

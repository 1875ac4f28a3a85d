"""Names of coordinates, bodies and constraints: for labels, files, and access to quantities by name."""

import difflib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from vmri_jax.mechanics.kinematics import Kinematics
from vmri_jax.mechanics.rows import Part, Place
from vmri_jax.mechanics.slots import Slots, free
from vmri_jax.mechanics.system import System
from vmri_jax.refusals import Refused

AXES = "xyz"
"""Coordinates of a point of two or three dimensions."""
Sizes = Mapping[str, int | tuple[int, ...]]
"""Numbers of entries by name, or shapes of arrays."""


@dataclass(frozen=True)
class Names:
    """Names and sizes of the bodies in q_s and q_f, and of the constraints in the values of the constraint functions,
    in order.

        Names(slow={"trolley": 1}, fast={"hook": 2, "load": 2}, constraint={"rope": 1})

    Args:
        slow, fast: bodies, or single coordinates, in the order of q_s and q_f, with their numbers of coordinates; with
            the shapes of their arrays if the user gave dictionaries of arrays: a run then returns its positions in the
            same form.
        constraint, slow_constraint: constraints in the order of the values of these functions, with their numbers of
            rows.
        numbered: bodies with generalised coordinates: these have the names "name[0]", "name[1]", not "name x", "name
            y".
        rigid: bodies whose coordinates are a centre and directors: "name x", "name y", "name z", "name d1 x" and so on.
        carried: places in Q_s and Q_f of the bodies that are functions of the coordinates, by name.
        kinematics: the map from q_s, q_f to Q_s, Q_f, see `vmri_jax.mechanics.kinematics`; None without such bodies.
        angles: coordinates of `slow` and `fast` that are angles, rad.

    Raises:
        TypeError: an argument that is no mapping from names to whole numbers.
        ValueError: a body that is slow and fast.
    """

    slow: Sizes = field(default_factory=dict)
    fast: Sizes = field(default_factory=dict)
    constraint: Mapping[str, int] = field(default_factory=dict)
    slow_constraint: Mapping[str, int] = field(default_factory=dict)
    numbered: Sequence[str] = ()
    rigid: Sequence[str] = ()
    carried: Mapping[str, Place] = field(default_factory=dict)
    kinematics: Kinematics | None = None
    angles: Sequence[str] = ()

    def __hash__(self) -> int:
        return hash((self.slots("s"), self.slots("f"), *self.constraint, *self.slow_constraint))

    def __post_init__(self):
        for field_name in ("slow", "fast", "constraint", "slow_constraint"):
            sizes = getattr(self, field_name)
            named = isinstance(sizes, Mapping) and all(isinstance(name, str) for name in sizes)
            if not (named and all(isinstance(n, tuple) or (isinstance(n, int) and n > 0) for n in sizes.values())):
                raise Refused(
                    f"Names: {field_name} is {sizes!r}; give a dictionary of names and sizes in the order of the "
                    "coordinates or rows, e.g. {'hook': 2, 'load': 2}."
                )
        both = sorted(set(self.slow) & set(self.fast))
        if both:
            raise Refused(f"Names: {', '.join(both)} in slow and in fast; give every body one place.")

    def slots(self, part: Part) -> Slots:
        """The bodies in q_s or q_f."""
        return Slots.of_sizes(self.slow if part == "s" else self.fast)

    @property
    def bodies(self) -> dict[str, Place]:
        """The place of every body."""
        bodies: dict[str, Place] = {}
        parts: tuple[Part, Part] = "s", "f"
        for part in parts:
            pieces = self.slots(part).slices.items()
            bodies |= {name: Place(part, piece.start, piece.stop - piece.start) for name, piece in pieces}
        return bodies

    def arrays(self, part: Part, size: int) -> Slots | None:
        """The arrays in q_s or q_f, of `size` coordinates, if the user gave a dictionary, else None.

        An empty part is like the other one.
        """
        parts = (self.slow, self.fast) if part == "s" else (self.fast, self.slow)
        sizes = parts[0] if size else parts[0] or parts[1]
        return self.slots(part) if any(isinstance(shape, tuple) for shape in sizes.values()) else None

    def shaped(self, part: Part, vectors) -> Any:
        """Vectors (..., n) in the form of the start: a dictionary of arrays by name, or the vectors themselves."""
        slots = self.arrays(part, vectors.shape[-1])
        return vectors if slots is None else slots.by_name(vectors)

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
        number = 0
        for name, size in [*self.constraint.items(), *self.slow_constraint.items()]:
            rows.setdefault(name, []).extend(range(number, number + size))
            number += size
        return rows

    def place_of(self, body: str) -> Place:
        """The place of a body, in (Q_s, Q_f) of the kinematics if it is a function of the coordinates.

        Raises:
            ValueError: no body of this name.
        """
        places = {**self.bodies, **self.carried}
        if body not in places:
            raise Refused(unknown("body", body, places))
        return places[body]

    def of(self, system: System, n_s: int, n_f: int) -> "Names":
        """These names, completed by plain names for coordinates and constraints of a system without a name.

        Raises:
            ValueError: sizes that do not add up to the numbers of coordinates and of constraint rows.
        """
        n_g, n_gs = system.num_constraints(np.zeros(n_s), np.zeros(n_f))
        rows = {"constraint": ("constraint", n_g), "slow_constraint": ("slow_constraint", n_gs)}
        return self._completed(rows).of_coordinates(n_s, n_f)

    def of_coordinates(self, n_s: int, n_f: int) -> "Names":
        """These names, completed by plain names for coordinates without a name.

        Raises:
            ValueError: sizes that do not add up to these numbers.
        """
        names = self._completed({"slow": ("q_s", n_s), "fast": ("q_f", n_f)})
        return replace(names, numbered=(*self.numbered, "q_s", "q_f"))

    def _completed(self, fields: Mapping[str, tuple[str, int]]) -> "Names":
        """These names, with a plain name for the entries of each field without names; fields have a plain name and the
        number of entries."""
        complete = {}
        for name, (plain, number) in fields.items():
            complete[name] = dict(getattr(self, name)) or ({plain: number} if number else {})
            size = Slots.of_sizes(complete[name]).size
            if size != number:
                raise Refused(
                    f"Names: {name} is {complete[name]}, which names {size}; the system has {number}. The sizes must "
                    "add up to that."
                )
        return replace(self, **complete)

    def _coordinates(self, sizes: Sizes) -> list[str]:
        names = []
        for name, shape in Slots.of_sizes(sizes).shapes:
            size = math.prod(shape)
            *rows, columns = shape or (1,)
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
        for part in {"slow", "fast"} & data.keys():
            fields[part] = {name: n if isinstance(n, int) else tuple(n) for name, n in data[part].items()}
        return cls(**fields)


def unknown(kind: str, name: Any, known: Iterable[str]) -> str:
    """The sentence that a name is unknown, with the most similar known name.

    Args:
        kind: of the objects with names, e.g. "body".
    """
    known = free(known)
    return f"there is no {kind} {name!r}.{near(name, known)} There are {', '.join(known) or 'none'}."


def near(name: Any, known: Iterable[str]) -> str:
    """A question with the most similar known name; empty if no name is similar."""
    close = difflib.get_close_matches(str(name), free(known), n=1)
    return f" Did you mean {close[0]}?" if close else ""

"""Parts of a drawing, and how they are read from plain data; every refusal names the entry that is wrong."""

import json
import operator
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from typing import Any

import numpy as np

from vmri_jax.mechanics.kinematics import Kinematics
from vmri_jax.mechanics.names import unknown
from vmri_jax.refusals import Refused

KINDS = ("link", "spring")
PACES = ("slow", "fast")
KEYS = (
    *("bodies", "solids", "blocks", "links", "springs", "anchors", "planes", "spheres"),
    *("up", "view", "caption", "kinematics"),
)


@dataclass(frozen=True)
class Body:
    """A point with 1 to 3 coordinates. Each is a linear form ``sum_k weight_k q[index_k]`` over q_s and q_f; without
    terms it is zero.

    Attributes:
        name: unique in a drawing.
        forms: for each coordinate its terms (weight, "s" or "f", index).
        offset: added to the linear forms: the position of the body at q = 0.
        radius: in the unit of the coordinates; None for a radius that depends on the size of the picture.
        color: as in CSS, ``#rrggbb``; None for the colour of its pace.
        shown: "ball"; "name" for the centre of a solid, which shows its name alone; or "" for a point that is not
            shown.
    """

    name: str
    forms: tuple[tuple[tuple[float, str, int], ...], ...]
    offset: tuple[float, ...]
    radius: float | None = None
    color: str | None = None
    shown: str = "ball"

    @property
    def pace(self) -> str:
        """ "slow" if all coordinates of q in it are slow, else "fast"."""
        return "slow" if all(part == "s" for form in self.forms for _, part, _ in form) else "fast"


@dataclass(frozen=True)
class Solid:
    """A convex solid that moves with four points x_i: a corner with the weights c is at
    ``x_0 + sum_i c_i (x_i - x_0)``.

    Attributes:
        points: names of the four bodies at the points, the centre first.
        corners: the weights (c_1, c_2, c_3) of each corner.
        faces: for each face the numbers of its corners, anticlockwise from outside.
        color: None for the colour of the pace of its centre.
    """

    points: tuple[str, ...]
    corners: tuple[tuple[float, ...], ...]
    faces: tuple[tuple[int, ...], ...]
    color: str | None = None


@dataclass(frozen=True)
class Block:
    """General coordinates, which are no coordinates of points: each is shown as a bar.

    Attributes:
        coordinates: ("s" or "f", index) of each.
        labels: their names.
    """

    name: str
    coordinates: tuple[tuple[str, int], ...]
    labels: tuple[str, ...]


@dataclass(frozen=True)
class Joint:
    """A line of the drawing: a link or spring between two bodies, or from a body to a fixed point; no joint of a scene.

    Attributes:
        kind: "link" or "spring".
        bodies: one name or two.
        point: the fixed point of a line with one body.
        pace: "slow" or "fast", which colours a spring; None for the pace of the bodies.
    """

    kind: str
    bodies: tuple[str, ...]
    point: tuple[float, ...] | None = None
    pace: str | None = None


@dataclass(frozen=True)
class Plane:
    """A wall or ground through `point`; bodies stay on the side of `normal`."""

    point: tuple[float, ...]
    normal: tuple[float, ...]


@dataclass(frozen=True)
class Sphere:
    """A fixed sphere."""

    center: tuple[float, ...]
    radius: float


def check_keys(data: Any, needed: Sequence[str], optional: Sequence[str], where: str) -> None:
    """Refuse data that is no dict, unknown entries, and missing entries."""
    known = (*needed, *optional)
    if not isinstance(data, dict):
        raise Refused(f"{where} is {type(data).__name__}; it must be a dict with {', '.join(known)}.")
    for key in data:
        if key not in known:
            raise Refused(f"{where}: {unknown('entry', key, known)}")
    for key in needed:
        if key not in data:
            raise Refused(f"{where} lacks the entry {key!r}.")


def entries(data: dict, key: str, where: str) -> list:
    """The list at a key, empty if the key is missing."""
    items = data.get(key, [])
    if not isinstance(items, list | tuple):
        raise Refused(f"{where}: {key} is {type(items).__name__}; it must be a list.")
    return list(items)


def _floats(value: Any) -> np.ndarray:
    """The value as an array of floats; a single NaN where it has other entries than numbers."""
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        return np.array(np.nan)


def numbers(value: Any, where: str) -> tuple[float, ...]:
    """1 to 3 finite numbers."""
    array = _floats(value)
    if array.ndim != 1 or not 1 <= array.size <= 3 or not np.isfinite(array).all():
        raise Refused(f"{where} is {value!r}; it must be a list of 1 to 3 finite numbers.")
    return tuple(array.tolist())


def direction(value: Any, where: str) -> tuple[float, ...]:
    """1 to 3 finite numbers that are not all zero."""
    vector = numbers(value, where)
    if not any(vector):
        raise Refused(f"{where} is {list(vector)}; it must not be zero.")
    return vector


def angles(value: Any, where: str) -> tuple[float, ...]:
    """Azimuth and elevation in degrees."""
    degrees = _floats(value)
    if degrees.shape != (2,) or not np.isfinite(degrees).all() or abs(degrees[1]) > 90:
        raise Refused(f"{where} is {value!r}; it must be azimuth and elevation in degrees, the latter from -90 to 90.")
    return tuple(degrees.tolist())


def positive(value: Any, where: str) -> float:
    """A positive number."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < np.inf:
        raise Refused(f"{where} is {value!r}; it must be a positive number.")
    return float(value)


def read_body(data: Any, where: str) -> Body:
    """The point body of a dict; `where` names the dict in messages, here and below."""
    check_keys(data, ("name", "coordinates"), ("offset", "radius", "color", "shown"), where)
    coordinates = data["coordinates"]
    if not isinstance(coordinates, list | tuple) or not 1 <= len(coordinates) <= 3:
        raise Refused(f"{where}: coordinates is {coordinates!r}; it must be a list of 1 to 3 entries.")
    radius = None if data.get("radius") is None else positive(data["radius"], f"{where}: radius")
    color = data.get("color")
    if color is not None and not (isinstance(color, str) and re.fullmatch("#[0-9a-fA-F]{6}", color)):
        raise Refused(f"{where}: color is {color!r}; it must be like '#0072b2'.")
    forms = tuple(_form(entry, where) for entry in coordinates)
    offset = numbers(data.get("offset") or [0.0] * len(forms), f"{where}: offset")
    shown = data.get("shown", "ball")
    if shown not in ("ball", "name", ""):
        raise Refused(f"{where}: shown is {shown!r}; it must be 'ball', 'name' or ''.")
    return Body(str(data["name"]), forms, offset, radius, color, shown)


def read_solid(data: Any, where: str) -> tuple[Solid, list[Body]]:
    """The solid, and the four points that it moves with: its centre, and one along each director."""
    check_keys(data, ("name", "coordinates", "corners", "faces"), ("color",), where)
    name = str(data["name"])
    forms = [_form(coordinate, where) for coordinate in entries(data, "coordinates", where)]
    corners = np.array([numbers(corner, f"{where}: corners") for corner in entries(data, "corners", where)])
    faces = tuple(tuple(operator.index(i) for i in face) for face in entries(data, "faces", where))
    count = len(forms) // 3 - 1
    if len(forms) != 3 * (count + 1) or not 1 <= count <= 3 or corners.ndim != 2 or corners.shape[1] != count:
        raise Refused(
            f"{where}: {len(forms)} coordinates and corners of shape {corners.shape}; give the 12 coordinates of a "
            "rigid body (or fewer, of one with fewer directors) and a number along each director for every corner."
        )
    if any(not 0 <= i < len(corners) for face in faces for i in face):
        raise Refused(
            f"{where}: a face has the number of a corner that does not exist; there are {len(corners)} corners."
        )
    # The points are the centre and, along each director, the point at the distance `size` of the farthest corner:
    # points at a length of 1 could lie far outside the picture.
    size = float(np.abs(corners).max()) or 1.0
    centre = tuple(forms[:3])
    bodies = [Body(name, centre, (0.0,) * 3, None, data.get("color"), "name")]
    for k in range(3):
        directors = forms[3 * (k + 1) : 3 * (k + 2)] or [()] * 3
        along = [(*a, *((size * w, part, i) for w, part, i in b)) for a, b in zip(centre, directors, strict=True)]
        bodies.append(Body(f"point on axis {k + 1} of {name},", tuple(along), (0.0,) * 3, shown=""))
    weights = np.pad(corners / size, [(0, 0), (0, 3 - count)])
    names = tuple(body.name for body in bodies)
    return Solid(names, tuple(map(tuple, weights.tolist())), faces, data.get("color")), bodies


def read_block(data: Any, where: str) -> Block:
    """The block of coordinates, without a place in the picture, of a dict."""
    check_keys(data, ("name", "coordinates"), ("labels",), where)
    forms = [_form(entry, where) for entry in entries(data, "coordinates", where)]
    if not forms or any(len(form) != 1 or form[0][0] != 1.0 for form in forms):
        raise Refused(f"{where}: coordinates is {data['coordinates']!r}; it must be a list of ['s' or 'f', index].")
    labels = [str(label) for label in entries(data, "labels", where)] or [
        f"{data['name']}[{i}]" for i in range(len(forms))
    ]
    if len(labels) != len(forms):
        raise Refused(f"{where}: there are {len(labels)} labels for {len(forms)} coordinates; give one for each.")
    return Block(str(data["name"]), tuple((part, index) for ((_, part, index),) in forms), tuple(labels))


def _form(entry: Any, where: str) -> tuple[tuple[float, str, int], ...]:
    """The terms of ``["s", 0]`` or ``[[weight, "s", 0], ...]``."""
    single = isinstance(entry, list | tuple) and len(entry) == 2 and isinstance(entry[0], str)
    try:
        terms = [(float(weight), part, operator.index(i)) for weight, part, i in ([(1.0, *entry)] if single else entry)]
    except (TypeError, ValueError):
        terms = [(np.nan, "", 0)]
    if not all(part in ("s", "f") and i >= 0 and np.isfinite(weight) for weight, part, i in terms):
        raise Refused(
            f"{where}: the coordinate {entry!r} must be ['s' or 'f', index] or a list of [weight, 's' or 'f', index]."
        )
    return tuple(terms)


def read_joint(kind: str, names: Sequence[str], entry: Any, where: str) -> Joint:
    """The line between two bodies of a pair of names, or of a pair and its pace; `names` of all bodies."""
    if not isinstance(entry, list | tuple) or len(entry) not in (2, 3):
        raise Refused(f"{where} is {entry!r}; it must be a pair of names, or a pair of names and 'slow' or 'fast'.")
    a, b = (_body_name(name, names, where) for name in entry[:2])
    if a == b:
        raise Refused(f"{where} joins {a!r} with itself.")
    return Joint(kind, (a, b), pace=_pace(entry[2] if len(entry) == 3 else None, where))


def read_anchor(names: Sequence[str], data: Any, where: str) -> Joint:
    """The line from a body to a fixed point of a dict; `names` of all bodies."""
    check_keys(data, ("body", "point", "kind"), ("pace",), where)
    if data["kind"] not in KINDS:
        raise Refused(f"{where}: kind is {data['kind']!r}; it must be {' or '.join(KINDS)}.")
    point = numbers(data["point"], f"{where}: point")
    body = _body_name(data["body"], names, where)
    return Joint(data["kind"], (body,), point, _pace(data.get("pace"), where))


def read_record(kind: type, readers: dict[str, Callable], data: Any, where: str) -> Any:
    """A `kind` from a dict with one entry for each reader, which checks and converts it."""
    check_keys(data, list(readers), (), where)
    return kind(**{key: read(data[key], f"{where}: {key}") for key, read in readers.items()})


def _body_name(name: Any, names: Sequence[str], where: str) -> str:
    if name not in names:
        raise Refused(f"{where}: {unknown('body', name, names)}")
    return name


def _pace(pace: Any, where: str) -> str | None:
    if pace is not None and pace not in PACES:
        raise Refused(f"{where}: the pace is {pace!r}; it must be {' or '.join(PACES)}.")
    return pace


def read_carried(data: Any) -> tuple[Kinematics, dict[str, np.ndarray]] | None:
    """The map from joint coordinates to coordinates of the bodies, and the arrays of its joints."""
    if data is None:
        return None
    check_keys(data, ("map", "joints"), (), "drawing: kinematics")
    return Kinematics.from_dict(data["map"]), {name: np.asarray(values) for name, values in data["joints"].items()}


def read_drawing(data: Any) -> dict[str, Any]:
    """The fields of a `Drawing` by name, from plain data or its JSON text."""
    if isinstance(data, str):
        try:
            data = json.loads(data)
        except json.JSONDecodeError as error:
            raise Refused(f"drawing: not valid JSON ({error}).") from error
    check_keys(data, (), KEYS, "drawing")

    def all_of(key: str, read: Callable) -> tuple:
        return tuple(read(entry, f"drawing: {key}[{i}]") for i, entry in enumerate(entries(data, key, "drawing")))

    bodies, blocks, solids = all_of("bodies", read_body), all_of("blocks", read_block), all_of("solids", read_solid)
    bodies = (*chain(*(points for _, points in solids)), *bodies)
    names = [body.name for body in bodies]
    if not bodies and not blocks:
        raise Refused("drawing: there are no bodies and no blocks; there must be at least one.")
    for name, count in Counter([*names, *(block.name for block in blocks)]).items():
        if count > 1:
            raise Refused(f"drawing: {count} bodies are named {name!r}; names must be unique.")
    links, springs = (all_of(f"{kind}s", partial(read_joint, kind, names)) for kind in KINDS)
    return {
        "bodies": bodies,
        "blocks": blocks,
        "solids": tuple(solid for solid, _ in solids),
        "joints": links + springs + all_of("anchors", partial(read_anchor, names)),
        "planes": all_of("planes", partial(read_record, Plane, {"point": numbers, "normal": direction})),
        "spheres": all_of("spheres", partial(read_record, Sphere, {"center": numbers, "radius": positive})),
        "up": None if data.get("up") is None else direction(data["up"], "drawing: up"),
        "view": None if data.get("view") is None else angles(data["view"], "drawing: view"),
        "caption": str(data.get("caption") or ""),
        "carried": read_carried(data.get("kinematics")),
    }

"""What a picture of a system is made of: bodies and what joins them, as plain data that can be stored next to a run."""

import json
import operator
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from typing import Any

import jax
import numpy as np

from vmri_jax.animation.checks import angles, check_keys, direction, entries, numbers, positive
from vmri_jax.mechanics.kinematics import Kinematics
from vmri_jax.mechanics.names import near

KEYS = (
    *("bodies", "solids", "blocks", "links", "springs", "anchors", "planes", "spheres"),
    *("up", "view", "caption", "kinematics"),
)
BLOCK_KEYS = ("name", "coordinates", "labels")
BODY_KEYS = ("name", "coordinates", "offset", "radius", "color", "shown")
SOLID_KEYS = ("name", "coordinates", "corners", "faces", "color")
FORMS_OF_CENTRES = ("ball", "name", "")
KINDS = ("link", "spring")
PACES = ("slow", "fast")


@dataclass(frozen=True)
class Body:
    """A point of 1 to 3 coordinates, each a linear form ``sum_k weight_k q[index_k]`` over q_s and q_f; none is zero.

    Attributes:
        name: unique in a drawing.
        forms: per coordinate its terms (weight, "s" or "f", index).
        offset: added to the coordinates: where the body is at q = 0.
        radius: in the unit of the coordinates; None for one that suits the picture.
        color: as in CSS, ``#rrggbb``; None for that of its pace.
        shown: "ball", "name" (of a solid, whose centre it is), or "" for a point of which nothing is shown.
    """

    name: str
    forms: tuple[tuple[tuple[float, str, int], ...], ...]
    offset: tuple[float, ...]
    radius: float | None = None
    color: str | None = None
    shown: str = "ball"

    @property
    def pace(self) -> str:
        """ "slow" if all its coordinates are, else "fast"."""
        return "slow" if all(part == "s" for form in self.forms for _, part, _ in form) else "fast"


@dataclass(frozen=True)
class Solid:
    """A convex solid that moves with four points: a corner with the weights c is at ``x_0 + sum_i c_i (x_i - x_0)``.

    Attributes:
        points: names of the four bodies, the centre first.
        corners: the weights (c_1, c_2, c_3) of each corner.
        faces: numbers of their corners, anticlockwise from outside.
        color: None for that of the pace of its centre.
    """

    points: tuple[str, ...]
    corners: tuple[tuple[float, ...], ...]
    faces: tuple[tuple[int, ...], ...]
    color: str | None = None


@dataclass(frozen=True)
class Block:
    """General coordinates, ("s" or "f", index) each, that are not those of a point: each is shown as a bar.

    labels: names of the coordinates, ``name[i]`` if they have none.
    """

    name: str
    coordinates: tuple[tuple[str, int], ...]
    labels: tuple[str, ...]


@dataclass(frozen=True)
class Joint:
    """A link or spring between two bodies, or from a body to a fixed point.

    Attributes:
        kind: "link" or "spring".
        bodies: one name or two.
        point: the fixed point, if there is one body.
        pace: "slow" or "fast", colours a spring; None for that of the bodies.
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


@dataclass(frozen=True)
class Drawing:
    """Bodies, solids, blocks of general coordinates, what joins bodies, fixed things around them.

    Attributes:
        up: the direction that is shown upwards, in coordinates of the bodies; None for the last coordinate (bodies of one
            coordinate move sideways).
        view: azimuth and elevation from which one looks, in degrees; None for one that suits. (-90, 0) is from the front, with
            x to the right; (-90, 90) from above.
        caption: a line that is shown with the picture.
        carried: the map from the coordinates of a run to those that bodies name, and the numbers of its joints, see
            `vmri_jax.mechanics.kinematics`; None where they are the same.
    """

    bodies: tuple[Body, ...]
    blocks: tuple[Block, ...] = ()
    solids: tuple[Solid, ...] = ()
    joints: tuple[Joint, ...] = ()
    planes: tuple[Plane, ...] = ()
    spheres: tuple[Sphere, ...] = ()
    up: tuple[float, ...] | None = None
    view: tuple[float, ...] | None = None
    caption: str = ""
    carried: tuple[Kinematics, dict[str, np.ndarray]] | None = None

    @classmethod
    def from_dict(cls, data: Any) -> "Drawing":
        """A drawing from plain data, checked.

        Args:
            data: a dict (or its JSON text) of

                - ``bodies``: dicts of ``name``; ``coordinates``, 1 to 3 entries ``["s" or "f", index]``, or linear forms
                  ``[[weight, "s" or "f", index], ...]``; and if wanted ``offset``, ``radius``, ``color``, ``shown``.
                - ``solids``: dicts of ``name``; ``coordinates`` of a rigid body, its centre and its directors; ``corners``, along
                  the directors; ``faces``; and if wanted ``color``.
                - ``blocks``: dicts of ``name``; ``coordinates``, any number of entries ``["s" or "f", index]``; and if wanted
                  ``labels``, a name for each of them.
                - ``links``, ``springs``: pairs of names, and a third entry "slow" or "fast" if wanted.
                - ``anchors``: dicts of ``body``, ``point``, ``kind`` ("link" or "spring"), and if wanted ``pace``.
                - ``planes``: dicts of ``point``, ``normal``; ``spheres``: dicts of ``center``, ``radius``.
                - ``up``, ``view``, ``caption``: see above; ``kinematics``: "map" and "joints" of `carried`, which a scene writes.

        Raises:
            ValueError: anything else, with the entry that is wrong.
        """
        if isinstance(data, str):
            try:
                data = json.loads(data)
            except json.JSONDecodeError as error:
                raise ValueError(f"drawing: not valid JSON ({error}).") from error
        check_keys(data, KEYS, (), "drawing")

        def all_of(key: str, read: Callable) -> tuple:
            return tuple(read(entry, f"drawing: {key}[{i}]") for i, entry in enumerate(entries(data, key, "drawing")))

        bodies, blocks, solids = all_of("bodies", _body), all_of("blocks", _block), all_of("solids", _solid)
        bodies = (*chain(*(points for _, points in solids)), *bodies)
        names = [body.name for body in bodies]
        if not bodies and not blocks:
            raise ValueError("drawing: there are no bodies and no blocks; there must be at least one.")
        for name, count in Counter([*names, *(block.name for block in blocks)]).items():
            if count > 1:
                raise ValueError(f"drawing: {count} bodies are named {name!r}; names must be unique.")
        links, springs = (all_of(f"{kind}s", partial(_joint, kind, names)) for kind in KINDS)
        return cls(
            bodies=bodies,
            blocks=blocks,
            solids=tuple(solid for solid, _ in solids),
            joints=links + springs + all_of("anchors", partial(_anchor, names)),
            planes=all_of("planes", partial(_record, Plane, {"point": numbers, "normal": direction})),
            spheres=all_of("spheres", partial(_record, Sphere, {"center": numbers, "radius": positive})),
            up=None if data.get("up") is None else direction(data["up"], "drawing: up"),
            view=None if data.get("view") is None else angles(data["view"], "drawing: view"),
            caption=str(data.get("caption") or ""),
            carried=_carried(data.get("kinematics")),
        )

    def extended(self, q_s, q_f, v_s, v_f) -> tuple[np.ndarray, ...]:
        """Coordinates that bodies name, and their rates, (k, n) each.

        Args:
            q_s, q_f, v_s, v_f: (k, n_s), (k, n_f) those of a run.
        """
        if self.carried is None:
            return q_s, q_f, v_s, v_f
        kinematics, joints = self.carried

        def at(q_s, q_f, v_s, v_f):
            bodies, rates = jax.jvp(lambda q_s, q_f: kinematics(q_s, q_f, joints), (q_s, q_f), (v_s, v_f))
            return *bodies, *rates

        return tuple(map(np.asarray, jax.jit(jax.vmap(at))(q_s, q_f, v_s, v_f)))

    def corners(self, points: np.ndarray) -> list[np.ndarray]:
        """(..., n, 3) corners of every solid.

        Args:
            points: (..., n_bodies, 3) positions of the bodies.
        """
        index = {body.name: i for i, body in enumerate(self.bodies)}
        found = []
        for solid in self.solids:
            centre, *others = (points[..., index[name], :] for name in solid.points)
            axes = np.stack([other - centre for other in others], axis=-2)
            found.append(centre[..., None, :] + np.array(solid.corners) @ axes)
        return found

    def pace(self, joint: Joint) -> str:
        """ "slow" or "fast": as it says, else "fast" if all its bodies are.

        Args:
            joint: between bodies of this drawing.
        """
        fast = all(body.pace == "fast" for body in self.bodies if body.name in joint.bodies)
        return joint.pace or ("fast" if fast else "slow")

    @property
    def paces(self) -> list[str]:
        """Those of its bodies and springs."""
        found = {body.pace for body in self.bodies}
        found |= {self.pace(joint) for joint in self.joints if joint.kind == "spring"}
        return [pace for pace in PACES if pace in found]

    @property
    def dimension(self) -> int:
        """Coordinates of a point: 1, 2 or 3, the most of any body or given point."""
        points = [joint.point or () for joint in self.joints] + [sphere.center for sphere in self.spheres]
        points += [vector for plane in self.planes for vector in (plane.point, plane.normal)]
        points += [vector for body in self.bodies for vector in (body.forms, body.offset)] + [self.up or ()]
        return max((len(point) for point in points), default=1)

    def frame(self) -> np.ndarray:
        """(3, dimension) matrix from coordinates of the bodies to those of the picture, where z points upwards."""
        return frame(self.up, self.dimension)

    def place(self, points: Sequence[tuple[float, ...]]) -> np.ndarray:
        """(n, 3) points of the picture.

        Args:
            points: points or directions in coordinates of the bodies; missing coordinates are zero.
        """
        d = self.dimension
        padded = np.array([np.pad(point, (0, d - len(point))) for point in points]).reshape(-1, d)
        return padded @ self.frame().T

    def maps(self, n_s: int, n_f: int) -> tuple[np.ndarray, np.ndarray]:
        """Offset (n, 3) and matrix (n, 3, n_s + n_f): where the bodies are in the picture, ``offset + matrix @ q``.

        Args:
            n_s, n_f: lengths of the slow and of the fast coordinates that `extended` gives.

        Raises:
            ValueError: a body uses a coordinate that q does not have.
        """
        first = {"s": 0, "f": n_s}
        matrix = np.zeros((len(self.bodies), self.dimension, n_s + n_f))
        for i, body in enumerate(self.bodies):
            for axis, form in enumerate(body.forms):
                for weight, part, index in form:
                    check_index(body.name, part, index, n_s, n_f)
                    matrix[i, axis, first[part] + index] += weight
        return self.place([body.offset for body in self.bodies]), np.einsum("ad,idq->iaq", self.frame(), matrix)


def _carried(data: Any) -> tuple[Kinematics, dict[str, np.ndarray]] | None:
    """The map of bodies on joints, of its plain data."""
    if data is None:
        return None
    check_keys(data, ("map", "joints"), ("map", "joints"), "drawing: kinematics")
    return Kinematics.from_dict(data["map"]), {name: np.asarray(values) for name, values in data["joints"].items()}


def frame(up: tuple[float, ...] | None, dimension: int) -> np.ndarray:
    """(3, dimension) matrix of orthonormal columns from coordinates to those of the picture, see `Drawing.up`."""
    if up is None:
        return np.array([[1.0], [0.0], [0.0]]) if dimension == 1 else _upright(np.eye(dimension)[-1])
    padded = np.pad(up, (0, dimension - len(up)))
    return _upright(padded / np.linalg.norm(padded))


def check_index(name: str, part: str, index: int, n_s: int, n_f: int) -> None:
    """Refuse a coordinate of a body or block that a run does not have."""
    size, pace = (n_s, "slow") if part == "s" else (n_f, "fast")
    if index >= size:
        raise ValueError(
            f"drawing: the body {name!r} uses [{part!r}, {index}], but the run has {size} {pace} coordinates; is this the "
            "drawing of another system?"
        )


def _upright(up: np.ndarray) -> np.ndarray:
    """Matrix of a rotation that takes the unit vector `up` to z, and keeps x where it can."""
    if up.size == 1:
        return np.array([[0.0], [0.0], [up[0]]])
    if up.size == 2:
        return np.array([[up[1], -up[0]], [0.0, 0.0], up])
    x = np.eye(3)[0 if abs(up[0]) < 0.9 else 1]
    x = x - (x @ up) * up
    x /= np.linalg.norm(x)
    return np.array([x, np.cross(up, x), up])


def _body(data: Any, where: str) -> Body:
    check_keys(data, BODY_KEYS, ("name", "coordinates"), where)
    coordinates = data["coordinates"]
    if not isinstance(coordinates, list | tuple) or not 1 <= len(coordinates) <= 3:
        raise ValueError(f"{where}: coordinates is {coordinates!r}; it must be a list of 1 to 3 entries.")
    radius = None if data.get("radius") is None else positive(data["radius"], f"{where}: radius")
    color = data.get("color")
    if color is not None and not (isinstance(color, str) and re.fullmatch("#[0-9a-fA-F]{6}", color)):
        raise ValueError(f"{where}: color is {color!r}; it must be like '#0072b2'.")
    forms = tuple(_form(entry, where) for entry in coordinates)
    offset = numbers(data.get("offset") or [0.0] * len(forms), f"{where}: offset")
    shown = data.get("shown", "ball")
    if shown not in FORMS_OF_CENTRES:
        raise ValueError(f"{where}: shown is {shown!r}; it must be 'ball', 'name' or ''.")
    return Body(str(data["name"]), forms, offset, radius, color, shown)


def _solid(data: Any, where: str) -> tuple[Solid, list[Body]]:
    """The solid, and the four points that it moves with: its centre, and one along each director."""
    check_keys(data, SOLID_KEYS, SOLID_KEYS[:4], where)
    name = str(data["name"])
    forms = [_form(coordinate, where) for coordinate in entries(data, "coordinates", where)]
    corners = np.array([numbers(corner, f"{where}: corners") for corner in entries(data, "corners", where)])
    faces = tuple(tuple(operator.index(i) for i in face) for face in entries(data, "faces", where))
    count = len(forms) // 3 - 1
    if len(forms) != 3 * (count + 1) or not 1 <= count <= 3 or corners.ndim != 2 or corners.shape[1] != count:
        raise ValueError(
            f"{where}: {len(forms)} coordinates and corners of shape {corners.shape}; give the 12 coordinates of a rigid body (or "
            "fewer, of one with fewer directors) and a number along each director for every corner."
        )
    if any(not 0 <= i < len(corners) for face in faces for i in face):
        raise ValueError(f"{where}: a face has corners that there are not; there are {len(corners)}.")
    size = float(np.abs(corners).max()) or 1.0
    centre = tuple(forms[:3])
    bodies = [Body(name, centre, (0.0,) * 3, None, data.get("color"), "name")]
    for k in range(3):
        directors = forms[3 * (k + 1) : 3 * (k + 2)] or [()] * 3
        along = [(*a, *((size * w, part, i) for w, part, i in b)) for a, b in zip(centre, directors, strict=True)]
        bodies.append(Body(f"{name} axis {k + 1}", tuple(along), (0.0,) * 3, shown=""))
    weights = np.pad(corners / size, [(0, 0), (0, 3 - count)])
    named = tuple(body.name for body in bodies)
    return Solid(named, tuple(map(tuple, weights.tolist())), faces, data.get("color")), bodies


def _block(data: Any, where: str) -> Block:
    check_keys(data, BLOCK_KEYS, BLOCK_KEYS[:2], where)
    forms = [_form(entry, where) for entry in entries(data, "coordinates", where)]
    if not forms or any(len(form) != 1 or form[0][0] != 1.0 for form in forms):
        raise ValueError(f"{where}: coordinates is {data['coordinates']!r}; it must be a list of ['s' or 'f', index].")
    labels = [str(label) for label in entries(data, "labels", where)] or [
        f"{data['name']}[{i}]" for i in range(len(forms))
    ]
    if len(labels) != len(forms):
        raise ValueError(f"{where}: there are {len(labels)} labels for {len(forms)} coordinates; give one for each.")
    return Block(str(data["name"]), tuple((part, index) for ((_, part, index),) in forms), tuple(labels))


def _form(entry: Any, where: str) -> tuple[tuple[float, str, int], ...]:
    """The terms of ``["s", 0]`` or ``[[weight, "s", 0], ...]``."""
    single = isinstance(entry, list | tuple) and len(entry) == 2 and isinstance(entry[0], str)
    try:
        terms = [(float(weight), part, operator.index(i)) for weight, part, i in ([(1.0, *entry)] if single else entry)]
    except (TypeError, ValueError):
        terms = [(np.nan, "", 0)]
    if not all(part in ("s", "f") and i >= 0 and np.isfinite(weight) for weight, part, i in terms):
        raise ValueError(
            f"{where}: the coordinate {entry!r} must be ['s' or 'f', index] or a list of [weight, 's' or 'f', index]."
        )
    return tuple(terms)


def _joint(kind: str, names: Sequence[str], entry: Any, where: str) -> Joint:
    if not isinstance(entry, list | tuple) or len(entry) not in (2, 3):
        raise ValueError(f"{where} is {entry!r}; it must be a pair of names, or one and 'slow' or 'fast'.")
    a, b = (_body_name(name, names, where) for name in entry[:2])
    if a == b:
        raise ValueError(f"{where} joins {a!r} with itself.")
    return Joint(kind, (a, b), pace=_pace(entry[2] if len(entry) == 3 else None, where))


def _anchor(names: Sequence[str], data: Any, where: str) -> Joint:
    check_keys(data, ("body", "point", "kind", "pace"), ("body", "point", "kind"), where)
    if data["kind"] not in KINDS:
        raise ValueError(f"{where}: kind is {data['kind']!r}; it must be {' or '.join(KINDS)}.")
    point = numbers(data["point"], f"{where}: point")
    body = _body_name(data["body"], names, where)
    return Joint(data["kind"], (body,), point, _pace(data.get("pace"), where))


def _record(kind: type, readers: dict[str, Callable], data: Any, where: str) -> Any:
    """What has just these entries, each read and checked by a function of its own."""
    check_keys(data, list(readers), list(readers), where)
    return kind(**{key: read(data[key], f"{where}: {key}") for key, read in readers.items()})


def _body_name(name: Any, names: Sequence[str], where: str) -> str:
    if name not in names:
        listed = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
        raise ValueError(
            f"{where} names the body {name!r}, which does not exist.{near(str(name), names)} There are {listed}."
        )
    return name


def _pace(pace: Any, where: str) -> str | None:
    if pace is not None and pace not in PACES:
        raise ValueError(f"{where}: the pace is {pace!r}; it must be {' or '.join(PACES)}.")
    return pace

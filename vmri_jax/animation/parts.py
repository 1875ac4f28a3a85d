"""Parts of a drawing: bodies, solids, blocks of general coordinates, joints, and fixed planes and spheres."""

from dataclasses import dataclass

KINDS = ("link", "spring")
PACES = ("slow", "fast")


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

"""How large things are drawn, where the ground lies, and from where one looks: shared by pages and pictures."""

import math
from dataclasses import dataclass

import numpy as np

from vmri_jax.animation.drawing import Drawing
from vmri_jax.animation.motion import Motion

TURNS = (4, 14)
"""Fewest and most turns of a spring."""
FADED = 0.45
"""A floor fades away outwards: so much of it must be seen."""
LEVEL = 0.9
"""Least vertical part of the unit normal of a plane that counts as level."""


@dataclass(frozen=True)
class Ground:
    """A rectangle of a plane: `center`, two unit `sides` with half lengths `halves`, `normal`, width `step` of its grid.

    solid: given by the drawing; else a floor below the scene that shows depth only.
    """

    center: np.ndarray
    sides: np.ndarray
    halves: tuple[float, float]
    normal: np.ndarray
    step: float
    solid: bool


@dataclass(frozen=True)
class Layout:
    """Sizes in the unit of the coordinates, and places in those of the picture.

    Attributes:
        size: diagonal of the box around all that moves.
        radii: of the bodies.
        rod, coil, wire: radius of links, of springs, and of their wire.
        joined: (n_joints, 2) bodies of all links and springs, and `lengths` their median lengths.
        anchors: (n_anchors, 3) fixed points; their joints follow those of `joined` in `lengths`.
        spheres: (n_spheres, 3) centres.
        grounds: given planes, or a floor.
        hull: (n, 3) points that must be seen.
        azimuth, elevation: of the first view.
    """

    size: float
    radii: np.ndarray
    rod: float
    coil: float
    wire: float
    anchors: np.ndarray
    spheres: np.ndarray
    turns: dict[str, list[int]]
    grounds: list[Ground]
    hull: np.ndarray
    azimuth: float
    elevation: float


def layout(motion: Motion) -> Layout:
    """Sizes that suit the picture: balls do not touch their neighbours, springs keep inside the space they have."""
    drawing, points = motion.drawing, motion.thinned(500).points
    anchors = drawing.place([anchor.point for anchor in drawing.anchors])
    spheres = drawing.place([sphere.center for sphere in drawing.spheres])
    reach = np.array([sphere.radius for sphere in drawing.spheres]).reshape(-1, 1)
    moving = np.concatenate([points.reshape(-1, 3), anchors, spheres - reach, spheres + reach])
    size = float(np.linalg.norm(np.ptp(moving, axis=0))) or 1.0
    lengths = _median_lengths(drawing, points, anchors)
    room = min([0.3 * length for joints in lengths.values() for length in joints if length > 0], default=math.inf)
    given = [body.radius for body in drawing.bodies]
    radii = np.array([min(0.02 * size, room) if radius is None else radius for radius in given])
    sprung = [length for key in ("springs", "spring anchors") for length in lengths[key] if length > 0]
    coil = min(0.015 * size, 0.16 * min(sprung, default=size))
    turns = {key: [_turns(length, coil) for length in joints] for key, joints in lengths.items()}
    grounds = _grounds(drawing, moving, float(radii.max()), size)
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    corners = [g.center + (1.0 if g.solid else FADED) * signs * g.halves @ g.sides for g in grounds]
    seen = np.concatenate([moving, *corners])
    flat = drawing.dimension < 3
    return Layout(
        size,
        radii,
        rod=min(0.0048 * size, 0.4 * float(radii.min())),
        coil=coil,
        wire=0.11 * coil,
        anchors=anchors,
        spheres=spheres,
        turns=turns,
        grounds=grounds,
        hull=_hull(seen),
        azimuth=math.radians(-88 if flat else -62),
        elevation=math.radians(7 if flat else 14),
    )


def _median_lengths(drawing: Drawing, points: np.ndarray, anchors: np.ndarray) -> dict[str, list[float]]:
    """Median lengths of the joints: "links", "springs", "link anchors" and "spring anchors", each in its order."""
    index = {body.name: i for i, body in enumerate(drawing.bodies)}

    def length(a, b) -> float:
        return float(np.median(np.linalg.norm(a - b, axis=-1)))

    found = {
        key: [length(*(points[:, index[name]] for name in joint.bodies)) for joint in joints]
        for key, joints in (("links", drawing.links), ("springs", drawing.springs))
    }
    for kind in ("link", "spring"):
        found[f"{kind} anchors"] = [
            length(points[:, index[anchor.body]], point)
            for anchor, point in zip(drawing.anchors, anchors, strict=True)
            if anchor.kind == kind
        ]
    return found


def _turns(length: float, coil: float) -> int:
    return int(np.clip(round(length / (1.1 * coil)), *TURNS))


def _grounds(drawing: Drawing, moving: np.ndarray, radius: float, size: float) -> list[Ground]:
    """Given planes, as far as the scene goes, and a floor below it if none of them is level."""
    points = drawing.place([plane.point for plane in drawing.planes])
    normals = drawing.place([plane.normal for plane in drawing.planes])
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    given = [_ground(p, n, moving, size, solid=True) for p, n in zip(points, normals, strict=True)]
    if np.any(np.abs(normals[:, 2]) > LEVEL):
        return given
    point = np.array([0.0, 0.0, moving[:, 2].min() - radius - 0.03 * size])
    return [_ground(point, np.array([0.0, 0.0, 1.0]), moving, size, solid=False), *given]


def _ground(point, normal, moving, size: float, *, solid: bool) -> Ground:
    low, high = moving.min(axis=0), moving.max(axis=0)
    middle = (low + high) / 2
    level = abs(normal[2]) > LEVEL
    first = np.cross(normal, [0.0, 1.0, 0.0] if level else [0.0, 0.0, 1.0])
    first /= np.linalg.norm(first)
    sides = np.array([first, np.cross(normal, first)])
    margin = (0.12 if level else 0.05) * size
    extent = np.ptp(moving @ sides.T, axis=0) / 2 + margin
    step = nice(max(float(extent.max()) / (6 if level else 2), size / 16))
    center = middle - ((middle - point) @ normal) * normal
    return Ground(center, sides, (float(extent[0]), float(extent[1])), normal, step, solid)


def _hull(points: np.ndarray, count: int = 200) -> np.ndarray:
    """The points farthest out in directions spread over the sphere (a Fibonacci spiral)."""
    k = np.arange(count) + 0.5
    z, angle = 1 - 2 * k / count, np.pi * (1 + np.sqrt(5)) * k
    directions = np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z])
    return points[np.unique(np.argmax(points @ directions, axis=0))]


def nice(x: float) -> float:
    """The one of 1, 2, 5 times a power of ten that is nearest to x in ratio."""
    power = 10.0 ** math.floor(math.log10(x))
    return min((digit * power for digit in (1, 2, 5, 10)), key=lambda y: abs(math.log(y / x)))

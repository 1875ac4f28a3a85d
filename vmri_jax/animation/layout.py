"""Sizes of balls, links and springs, the ground, and the first view, for pages and pictures."""

import math
from dataclasses import dataclass

import numpy as np

from vmri_jax.animation.drawing import Drawing
from vmri_jax.animation.geometry import grid
from vmri_jax.animation.motion import Motion

TURNS_RANGE = (4, 14)
"""Smallest and largest number of turns of a spring."""
FLOOR_IN_VIEW = 0.45
"""Part of the floor that the view has to contain, from its middle to its corners; the rest has faded away. A larger
part makes the scene smaller."""
HIDDEN_RADIUS = 0.01
"""Radius of a point that is not drawn as a ball, over the default radius of a ball: joints end at this distance from
it."""
LEVEL_COSINE = 0.9
"""Smallest cosine between the vertical and the normal of a plane that counts as level."""


@dataclass(frozen=True)
class Ground:
    """A rectangle of a plane, with unit vectors (2, 3) along its sides, its corners (4, 3), and a `grid` (n, 7).

    It is solid if it is a plane of the drawing, not a floor below the scene that only shows depth.
    """

    center: np.ndarray
    normal: np.ndarray
    sides: np.ndarray
    corners: np.ndarray
    grid: np.ndarray
    solid: bool

    @property
    def bears(self) -> bool:
        """Whether shadows fall on this ground."""
        return bool(self.normal[2] > 0.5)


@dataclass(frozen=True)
class Layout:
    """Sizes in the unit of the coordinates, positions in coordinates of the picture, and the first view.

    size: diagonal of the box around bodies, solids, spheres and fixed points along the whole motion.
    rod, coil, wire: radius of links, of springs, and of the wire of springs.
    turns: of each joint, which springs have.
    grounds: planes of the drawing, and a floor if none of them is level.
    hull: (n, 3) points that the view has to contain.
    """

    size: float
    radii: np.ndarray
    rod: float
    coil: float
    wire: float
    turns: list[int]
    spheres: np.ndarray
    sphere_radii: np.ndarray
    grounds: list[Ground]
    hull: np.ndarray
    azimuth: float
    elevation: float


def layout(motion: Motion) -> Layout:
    """Sizes for a picture: balls do not touch their neighbours, coils are thinner than the shortest spring is long."""
    drawing, points = motion.drawing, motion.thinned(500).points
    fixed = drawing.place([joint.point for joint in drawing.joints if joint.point is not None])
    spheres = drawing.place([sphere.center for sphere in drawing.spheres])
    sphere_radii = np.array([sphere.radius for sphere in drawing.spheres])
    reach = sphere_radii[:, None]
    corners = [corner.reshape(-1, 3) for corner in drawing.corners(points)]
    box = np.concatenate([points.reshape(-1, 3), *corners, fixed, spheres - reach, spheres + reach])
    size = float(np.linalg.norm(np.ptp(box, axis=0))) or 1.0
    lengths = [float(np.median(drawing.length(joint, points))) or size for joint in drawing.joints]
    small = min(0.02 * size, 0.3 * min(lengths, default=size))
    balls = [body.shown == "ball" for body in drawing.bodies]
    radii = np.where(balls, [body.radius or small for body in drawing.bodies], HIDDEN_RADIUS * small)
    sprung = [length for joint, length in zip(drawing.joints, lengths, strict=True) if joint.kind == "spring"]
    coil = min(0.015 * size, 0.16 * min(sprung, default=size))
    grounds = _grounds(drawing, box, float(radii.max()), size)
    corners = [g.center + (1.0 if g.solid else FLOOR_IN_VIEW) * (g.corners - g.center) for g in grounds]
    azimuth, elevation = drawing.view or ((-88, 7) if drawing.dimension < 3 else (-62, 14))
    return Layout(
        size,
        radii,
        rod=min(0.0048 * size, 0.4 * min(radii[balls].tolist(), default=small)),
        coil=coil,
        wire=0.11 * coil,
        turns=np.clip(np.rint(np.array(lengths) / (1.1 * coil)), *TURNS_RANGE).astype(int).tolist(),
        spheres=spheres,
        sphere_radii=sphere_radii,
        grounds=grounds,
        hull=_hull(np.concatenate([box, *corners])),
        azimuth=math.radians(azimuth),
        elevation=math.radians(elevation),
    )


def _grounds(drawing: Drawing, box: np.ndarray, radius: float, size: float) -> list[Ground]:
    """Planes of the drawing, cut to the size of the scene, and a floor below the scene if none of them is level."""
    points = drawing.place([plane.point for plane in drawing.planes])
    normals = drawing.place([plane.normal for plane in drawing.planes])
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    planes = [_ground(p, n, box, size, solid=True) for p, n in zip(points, normals, strict=True)]
    if np.any(np.abs(normals[:, 2]) > LEVEL_COSINE):
        return planes
    point = np.array([0.0, 0.0, box[:, 2].min() - radius - 0.03 * size])
    return [_ground(point, np.array([0.0, 0.0, 1.0]), box, size, solid=False), *planes]


def _ground(point, normal, box, size: float, *, solid: bool) -> Ground:
    low, high = box.min(axis=0), box.max(axis=0)
    middle = (low + high) / 2
    level = abs(normal[2]) > LEVEL_COSINE
    first = np.cross(normal, [0.0, 1.0, 0.0] if level else [0.0, 0.0, 1.0])
    first /= np.linalg.norm(first)
    sides = np.array([first, np.cross(normal, first)])
    margin = (0.12 if level else 0.05) * size
    extent = np.ptp(box @ sides.T, axis=0) / 2 + margin
    step = nice(max(float(extent.max()) / (6 if level else 2), size / 16))
    center = middle - ((middle - point) @ normal) * normal
    halves = float(extent[0]), float(extent[1])
    corners = center + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * halves @ sides
    return Ground(center, normal, sides, corners, grid(center, sides, halves, step, fades=not solid), solid)


def _hull(points: np.ndarray, count: int = 200) -> np.ndarray:
    """The farthest points in `count` directions spread evenly over the sphere (a Fibonacci spiral)."""
    k = np.arange(count) + 0.5
    z, angle = 1 - 2 * k / count, np.pi * (1 + np.sqrt(5)) * k
    directions = np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z])
    return points[np.unique(np.argmax(points @ directions, axis=0))]


def nice(x: float) -> float:
    """The number of the form 1, 2 or 5 times a power of ten whose ratio to x is closest to 1."""
    power = 10.0 ** math.floor(math.log10(x))
    return min((digit * power for digit in (1, 2, 5, 10)), key=lambda y: abs(math.log(y / x)))

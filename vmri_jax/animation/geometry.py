"""Shapes at rest, as points, for strips, GIFs and the page; and the camera of strips and GIFs, as in the page.

Grids and helices are computed here once; the page gets them as numbers. Shapes that depend on time (the ends of a
joint, a helix between two bodies) are computed by the script of the page at play time, from the same numbers: every
node of a long run with every turn of its springs would make a page of many megabytes.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

LAMP = (-0.45, 0.7, 0.55)
"""Direction to the lamp: right, up, back of the view."""
JOINT_END = 0.8
"""Distance of the end of a joint from the centre of its ball, over the radius of the ball; below 1 the ball hides the
end."""
STRAIGHT_PART = 0.1
"""Length of the straight piece at each end of a spring, over the length of the spring."""
PIECES_PER_LINE = 16
"""Number of pieces of a line of a grid, each with its own strength; more make the fading smoother and the page
larger."""
FIELD = 1 / math.tan(math.pi / 12)
"""Cotangent of half the angle of view, 15 degrees. A larger one is a narrower angle, from farther away."""
FILLED_PART = 0.9
"""Part of the width or height of the view that the scene fills."""


@dataclass(frozen=True)
class Camera:
    """A camera that looks at `target` from `distance` in the direction of azimuth and elevation (radians); z points
    upwards.

    Heights in the view go from -1 to 1.
    """

    azimuth: float
    elevation: float
    target: np.ndarray
    distance: float

    @property
    def axes(self) -> np.ndarray:
        """(3, 3) unit vectors to the right, up and back of the view."""
        (ca, sa), (ce, se) = ((math.cos(a), math.sin(a)) for a in (self.azimuth, self.elevation))
        back, right = np.array([ce * ca, ce * sa, se]), np.array([-sa, ca, 0.0])
        return np.array([right, np.cross(back, right), back])

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions (..., 2) in the view and scales (...), the size in the view of a unit length at the point; 0 behind
        the camera."""
        right, up, depth = np.moveaxis((points - self.target) @ self.axes.T, -1, 0)
        depth = self.distance - depth
        scale = np.where(depth > 1e-3 * self.distance, FIELD / np.maximum(depth, 1e-300), 0.0)
        return np.stack([scale * right, scale * up], axis=-1), scale

    def fitted(self, points: np.ndarray, radius: float, aspect: float) -> "Camera":
        """A camera in the same direction that sees all balls of this radius at the points, in a view `aspect` times as
        wide as high."""
        camera = replace(self, target=(points.min(axis=0) + points.max(axis=0)) / 2)
        camera = replace(camera, distance=2 * float(np.linalg.norm(np.ptp(points, axis=0))) + 4 * radius)
        # Sizes in the view are nearly proportional to 1 / distance; a dozen corrections settle them to round-off of a
        # pixel.
        for _ in range(12):
            low, high = camera.bounds(points, radius)
            shift = (low + high) / 2 * camera.distance / FIELD
            factor = max((high[0] - low[0]) / (2 * FILLED_PART * aspect), (high[1] - low[1]) / (2 * FILLED_PART))
            target = camera.target + shift @ camera.axes[:2]
            camera = replace(camera, target=target, distance=camera.distance * float(factor))
        return camera

    def bounds(self, points: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Lower left and upper right corner, in the view, of the box around all balls of this radius."""
        xy, scale = self.project(points)
        reach = (scale * radius)[:, None]
        return (xy - reach).min(axis=0), (xy + reach).max(axis=0)


def helix(turns: int, per_turn: int = 16) -> np.ndarray:
    """A spring whose number of turns stays when it stretches: one row (share, radius, cos, sin) per point.

    The point of a row is ``start + share (end - start) + radius coil (cos n + sin m)``, with unit vectors n and m
    across the axis.
    """
    turn = np.arange(turns * per_turn + 1) / per_turn
    radius = np.minimum(1, np.minimum(turn, turns - turn))
    share = STRAIGHT_PART + (1 - 2 * STRAIGHT_PART) * turn / turns
    return np.stack([share, radius, np.cos(2 * np.pi * turn), np.sin(2 * np.pi * turn)], axis=1)


def grid(center, sides, halves: tuple[float, float], step: float, fades: bool) -> np.ndarray:
    """Pieces of lines at a distance `step` on a rectangle with half lengths and unit vectors (2, 3) of its sides.

    Each is a row (from, to, strength) of seven numbers; strengths are 1, or fall to 0 outwards if the grid `fades`.
    """
    rows = []
    for across in (0, 1):
        along, beside = halves[1 - across], halves[across]
        count = int(beside / step)
        for k in range(-count, count + 1):
            w = np.linspace(-along, along, PIECES_PER_LINE + 1)
            uv = np.stack([np.full(PIECES_PER_LINE + 1, k * step), w], axis=1)[:, :: -1 if across else 1]
            line = center + uv @ sides
            outwards = np.linalg.norm((uv[:-1] + uv[1:]) / 2 / halves, axis=1)
            strength = np.clip(1 - outwards, 0, 1) if fades else np.ones(PIECES_PER_LINE)
            rows.append(np.concatenate([line[:-1], line[1:], strength[:, None]], axis=1))
    pieces = np.concatenate(rows)
    return pieces[pieces[:, 6] > 0]


def joint(a, b, reach: tuple[float, float]):
    """Start and end of a joint between two balls with radii `reach`; None if an end lies within the other ball."""
    gap = b - a
    length = float(np.linalg.norm(gap))
    if length <= max(JOINT_END * sum(reach), *reach):
        return None
    return a + JOINT_END * reach[0] / length * gap, b - JOINT_END * reach[1] / length * gap


def spring(start, end, coil: float, turns: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) of a helix of radius `coil` with straight ends, and unit vectors from the axis to its turns."""
    along = (end - start) / np.linalg.norm(end - start)
    sideways = np.cross(along, [0.36, 0.48, 0.8])  # a direction in which few springs lie
    sideways /= np.linalg.norm(sideways)
    share, radius, cos, sin = helix(turns).T[:, :, None]
    radial = cos * sideways + sin * np.cross(along, sideways)
    turning = start + share * (end - start) + coil * radius * radial
    return np.concatenate([start[None], turning, end[None]]), radial


def dropped(center, normal, points) -> np.ndarray:
    """The feet of points (n, 3) straight below them, on a plane that is not vertical."""
    height = (center - points) @ normal / normal[2]
    return points + height[:, None] * np.array([0.0, 0.0, 1.0])

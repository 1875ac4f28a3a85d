"""A perspective view of the motion, as in the script of the page."""

import math
from dataclasses import dataclass, replace

import numpy as np

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

"""A perspective view of the motion, as in the script of the page."""

import math
from dataclasses import dataclass, replace

import numpy as np

FIELD = 1 / math.tan(math.pi / 12)
"""Half the height of the view is seen under 15 degrees."""
FILLED = 0.9
"""Part of the view that is filled."""


@dataclass(frozen=True)
class Camera:
    """Looks at `target` from `distance` in the direction of azimuth and elevation (radians); z points upwards.

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
        """Positions (..., 2) in the view and scales (...): size there of a unit length here; zero behind the eye."""
        right, up, depth = np.moveaxis((points - self.target) @ self.axes.T, -1, 0)
        depth = self.distance - depth
        scale = np.where(depth > 1e-3 * self.distance, FIELD / np.maximum(depth, 1e-300), 0.0)
        return np.stack([scale * right, scale * up], axis=-1), scale

    def fitted(self, points: np.ndarray, radius: float, aspect: float) -> "Camera":
        """The same direction, with all balls of this radius in a view `aspect` times as wide as high."""
        camera = replace(self, target=(points.min(axis=0) + points.max(axis=0)) / 2)
        camera = replace(camera, distance=2 * float(np.linalg.norm(np.ptp(points, axis=0))) + 4 * radius)
        for _ in range(12):
            low, high = camera.bounds(points, radius)
            shift = (low + high) / 2 * camera.distance / FIELD
            factor = max((high[0] - low[0]) / (2 * FILLED * aspect), (high[1] - low[1]) / (2 * FILLED))
            target = camera.target + shift @ camera.axes[:2]
            camera = replace(camera, target=target, distance=camera.distance * float(factor))
        return camera

    def bounds(self, points: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Lower left and upper right corner of balls in the view."""
        xy, scale = self.project(points)
        reach = (scale * radius)[:, None]
        return (xy - reach).min(axis=0), (xy + reach).max(axis=0)

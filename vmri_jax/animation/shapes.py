"""One moment of a motion in a matplotlib panel, painted from the farthest part to the nearest, as in the script of the
page."""

import math
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path

from vmri_jax import plots
from vmri_jax.animation.geometry import LAMP, Camera, dropped, joint, spring
from vmri_jax.animation.layout import Ground, Layout, layout
from vmri_jax.animation.motion import Motion

FRONT_ZORDER = 1e9
"""Drawing order of text: in front of all parts, whose order is their scale in the view."""
AMBIENT_SHADE = -0.12
"""Shade of a face at a right angle to the lamp, from -1 (dark) to 1 (light)."""
TRAIL_POINTS = (160, 2000)
"""Smallest and largest number of points of a trail."""
SHADOW = "#000000"
NAME_SIZE = 7.5
"""Font size of the names of bodies, in points."""
Place = tuple[float, float, float, float]
"""Left, bottom, width and height of a panel, in parts of the figure."""


@dataclass(frozen=True)
class Stage:
    """Sizes, colours and view of all pictures of a motion; the view is `aspect` times as wide as high."""

    motion: Motion
    sizes: Layout
    camera: Camera
    aspect: float
    theme: plots.Theme

    @classmethod
    def of(cls, motion: Motion, theme: plots.Theme) -> "Stage":
        """The stage of a motion with its first view; the frame is as wide as the scene, between half and eight times
        its height."""
        sizes = layout(motion)
        radius = float(sizes.radii.max())
        start = Camera(sizes.azimuth, sizes.elevation, np.zeros(3), 1.0)
        low, high = start.fitted(sizes.hull, radius, 1.0).bounds(sizes.hull, radius)
        aspect = float(np.clip((high[0] - low[0]) / (high[1] - low[1]), 0.5, 8.0))
        return cls(motion, sizes, start.fitted(sizes.hull, radius, aspect), aspect, theme)

    def draw(self, figure: Figure, place: Place, time: float, trail: float, *, names: bool = False) -> None:
        """Draw one moment, with trails of this duration, in a figure in the style of the theme; with `names` beside
        bodies where there is room."""
        figure.set_layout_engine("none")
        axes = figure.add_axes(place)
        axes.set_axis_off()
        axes.set(xlim=(-self.aspect, self.aspect), ylim=(-1, 1), aspect="equal")
        pen = _Pen(axes, self.camera, self.theme, 72 * place[2] * figure.get_figwidth() / (2 * self.aspect))
        points = self.motion.at([time])[0]
        self._draw_around(pen, points)
        past = self.motion.at(self._trail_times(max(float(self.motion.t[0]), time - trail), time))
        drawing, bodies = self.motion.drawing, self.motion.drawing.bodies
        colors = [body.color or self.paces[body.pace] for body in bodies]
        balls = [i for i, body in enumerate(bodies) if body.shown == "ball"]
        for i in balls:
            pen.trail(past[:, i], colors[i], self.sizes.radii[i])
        self._draw_joints(pen, points)
        for i in balls:
            pen.ball(points[i], self.sizes.radii[i], colors[i])
        for solid, corners in zip(drawing.solids, drawing.corners(points), strict=True):
            for face in solid.faces:
                pen.face(corners[list(face)], solid.color or colors[drawing.numbers[solid.points[0]]])
        if names:
            named = [i for i, body in enumerate(bodies) if body.shown]
            pen.names(points[named], self.sizes.radii[named], [bodies[i].name for i in named])
        span = float(self.motion.t[-1] - self.motion.t[0])
        digits = max(0, 2 - math.floor(math.log10(span))) if span > 0 else 2
        label = f"$t = {time:.{digits}f}$"
        axes.text(-0.97 * self.aspect, -0.97, label, va="bottom", fontsize=9, color=self.theme.ink, zorder=FRONT_ZORDER)

    @property
    def paces(self) -> dict[str, str]:
        """Colours of slow and of fast parts."""
        return {"slow": self.theme.curves[0], "fast": self.theme.curves[1]}

    def _trail_times(self, start: float, end: float) -> np.ndarray:
        """Times of the points of a trail, two for each node: with fewer points fast motion would be a zigzag."""
        nodes = int(np.sum((self.motion.t >= start) & (self.motion.t <= end)))
        return np.linspace(start, end, int(np.clip(2 * nodes, *TRAIL_POINTS)))

    def _draw_around(self, pen: "_Pen", points: np.ndarray) -> None:
        """Draw the planes with the shadows on them, and fixed spheres."""
        sizes, drawing = self.sizes, self.motion.drawing
        balls = [i for i, body in enumerate(drawing.bodies) if body.shown == "ball"]
        centers = np.concatenate([points[balls], sizes.spheres])
        radii = np.concatenate([sizes.radii[balls], sizes.sphere_radii])
        for ground in sizes.grounds:
            pen.ground(ground)
            if ground.bears:
                ends = [drawing.ends(line, points) for line in drawing.joints]
                pen.shadows(ground, centers, radii, ends, sizes.rod)
                for solid, corners in zip(drawing.solids, drawing.corners(points), strict=True):
                    pen.shadow(ground, [corners[list(face)] for face in solid.faces])
        for center, radius in zip(sizes.spheres, sizes.sphere_radii, strict=True):
            pen.ball(center, radius, self.theme.faint)

    def _draw_joints(self, pen: "_Pen", points: np.ndarray) -> None:
        sizes, drawing = self.sizes, self.motion.drawing
        for line, turns in zip(drawing.joints, sizes.turns, strict=True):
            a, b = drawing.ends(line, points)
            reach = [sizes.radii[drawing.numbers[name]] for name in line.bodies] + [0.0] * (line.point is not None)
            ends = joint(a, b, (reach[0], reach[1]))
            if ends is not None and line.kind == "link":
                pen.rod(*ends, sizes.rod, sizes.size)
            elif ends is not None:
                pen.spring(*ends, sizes.coil, sizes.wire, self.paces[drawing.pace(line)], turns)
            if line.point is not None and np.linalg.norm(a - b) > reach[0]:  # else the ball of the body hides the point
                pen.ball(b, 1.5 * sizes.rod, self.theme.rod)


def outward(corners) -> np.ndarray:
    """A vector at a right angle to a face, outwards."""
    return np.cross(corners[1] - corners[0], corners[2] - corners[1])


class _Pen:
    """Draws parts in a panel, as a camera sees them; `points` is the length of a unit of the view in typographic
    points."""

    def __init__(self, axes: Axes, camera: Camera, theme: plots.Theme, points: float):
        self.axes, self.camera, self.theme, self.points = axes, camera, theme, points
        self.strength = 1.0 if theme is plots.LIGHT else 2.0  # of shadows

    def tone(self, color, shade):
        """Shades of a colour: -1 is nearly black, 0 the colour, 1 white."""
        shade = np.atleast_1d(shade)[:, None]
        ends = np.where(shade < 0, 0.06, 1.0)
        return np.array(to_rgb(color)) * (1 - np.abs(shade)) + ends * np.abs(shade)

    def lines(self, ends, colors, widths, zorder: float, **style) -> None:
        """Segments (n, 2, 2), their widths in typographic points."""
        lines = LineCollection(list(ends), colors=colors, linewidths=np.maximum(0.5, widths), zorder=zorder, **style)
        self.axes.add_collection(lines, autolim=False)

    def ball(self, center, radius: float, color) -> None:
        """A ball as discs that grow smaller and lighter towards the lamp. Nearer parts have a larger scale and are
        drawn later."""
        (x, y), scale = self.camera.project(center)
        share = np.linspace(0, 1, int(np.clip(2 * self.points * scale * radius, 12, 60)))
        r = scale * radius * (1 - 0.93 * share)
        shades = np.interp(share, [0, 0.45, 0.8, 1], [-0.42, 0.0, 0.4, 0.75])
        shift = scale * radius * share
        xy = np.stack([x - 0.34 * shift, y + 0.42 * shift], axis=1)
        area = (2 * self.points * r) ** 2
        self.axes.scatter(*xy.T, s=area, c=self.tone(color, shades), linewidths=0, zorder=float(scale))

    def face(self, corners, color) -> None:
        """A face of a convex solid, lit by the lamp, if its outer side is turned to the camera."""
        normal = outward(corners)
        normal = normal / max(float(np.linalg.norm(normal)), 1e-300)
        back = self.camera.axes[2]
        eye = self.camera.target + self.camera.distance * back
        places, scale = self.camera.project(corners)
        if normal @ (eye - corners.mean(axis=0)) <= 0 or not (scale > 0).all():
            return
        bright = float((self.camera.axes @ normal) @ LAMP / np.linalg.norm(LAMP))
        tone = self.tone(color, AMBIENT_SHADE + (0.5 if bright > 0 else 0.35) * bright)[0]
        style = {"facecolor": tone, "edgecolor": tone, "linewidth": 0.4, "joinstyle": "round"}
        self.axes.add_patch(PathPatch(Path(places, closed=False), zorder=float(scale.mean()), **style))

    def rod(self, start, end, radius: float, size: float) -> None:
        """A rod in pieces, each with a depth of its own, so that bodies may hide a part of the rod."""
        pieces = int(np.clip(np.ceil(10 * np.linalg.norm(end - start) / size), 1, 12))
        places, scale = self.camera.project(start + np.linspace(0, 1, pieces + 1)[:, None] * (end - start))
        along = places[-1] - places[0]
        along /= max(float(np.linalg.norm(along)), 1e-12)
        side = np.array([along[1], -along[0]])
        side *= 1.0 if side @ LAMP[:2] > 0 else -1.0
        overlap = 0.3 / self.points * np.array([-along, along])  # without it seams show between pieces
        tones = self.tone(self.theme.rod, [-0.35, 0.05, 0.5])
        for k in range(pieces):
            w = radius * (scale[k] + scale[k + 1])
            middle = float(scale[k] + scale[k + 1]) / 2
            shifts = np.array([0.0, 0.12, 0.25])[:, None, None] * w * side
            widths = self.points * np.array([1.0, 0.72, 0.25]) * w
            self.lines(places[[k, k + 1]] + overlap + shifts, tones, widths, middle, capstyle="butt")

    def spring(self, start, end, coil: float, wire: float, color, turns: int) -> None:
        """A helix, lit from the side of the lamp."""
        points, radial = spring(start, end, coil, turns)
        places, scale = self.camera.project(points)
        bright = 0.45 * (radial @ self.camera.axes.T) @ LAMP
        shades = np.concatenate([[0.0], bright[1:], [0.0]])
        order = np.argsort(scale[:-1] + scale[1:])
        segments = np.stack([places[:-1], places[1:]], axis=1)
        widths = self.points * wire * (scale[:-1] + scale[1:])
        tones = self.tone(color, shades)
        self.lines(segments[order], tones[order], widths[order], float(scale.mean()), capstyle="round")

    def trail(self, path, color, radius: float) -> None:
        """The trail of a ball, from its surface on, fading into the past."""
        outside = np.linalg.norm(path - path[-1], axis=1) >= 0.9 * radius
        path = path[: len(path) - int(np.argmax(outside[::-1]))] if outside.any() else path[:0]
        if len(path) < 2:
            return
        places, scale = self.camera.project(path)
        young = np.linspace(0, 1, len(path) - 1)
        segments = np.stack([places[:-1], places[1:]], axis=1)
        behind = 0.998 * float(scale.mean())
        self.lines(segments, color, 0.5 + 0.9 * young, behind, alpha=0.7 * young**1.5, capstyle="butt")

    def names(self, points, radii, names: list[str]) -> None:
        """Names to the right or left of the balls, the largest ball first; a name that would cover a ball or another
        name is left out."""
        places, scale = self.camera.project(points)
        letter, sizes = NAME_SIZE / self.points, scale * radii
        edge = np.array(self.axes.get_xlim())
        taken = [np.array([place - 0.7 * size, place + 0.7 * size]) for place, size in zip(places, sizes, strict=True)]
        for i in np.argsort(-sizes, kind="stable"):
            shift, width = 0.75 * sizes[i] + 0.15 * letter, 0.6 * letter * len(names[i])
            for left in (shift, -shift - width):
                corner = places[i] + [left, shift]
                box = corner + np.array([[0.0, 0.0], [width, 1.2 * letter]])
                inside = edge[0] < box[0, 0] and box[1, 0] < edge[1]
                if inside and not any(np.all(box[0] < other[1]) and np.all(other[0] < box[1]) for other in taken):
                    taken.append(box)
                    x, y = corner.tolist()
                    ink = self.theme.ink
                    self.axes.text(x, y, names[i], va="bottom", fontsize=NAME_SIZE, color=ink, zorder=FRONT_ZORDER)
                    break

    def ground(self, ground: Ground) -> None:
        """The grid of a ground; a solid plane is tinted as well."""
        places, scale = self.camera.project(ground.grid[:, :6].reshape(-1, 2, 3))
        seen = (scale > 0).all(axis=1)
        self.lines(places[seen], self.theme.faint, 0.7, -3, alpha=ground.grid[seen, 6])
        if ground.solid:
            self.polygons([ground.corners], self.theme.faint, 0.4, -4)

    def shadows(self, ground: Ground, points, radii, joints, rod: float) -> None:
        """Shadows of balls and joints, straight down onto a ground. Balls are one path and joints another, so that
        overlaps are no darker."""
        angle = np.linspace(0, 2 * np.pi, 25)[:-1]
        circle = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ ground.sides
        feet = dropped(ground.center, ground.normal, points)
        above = (points - ground.center) @ ground.normal > 0
        # discs of growing radius and low opacity make a soft edge
        for grown in np.arange(0.7, 1.5, 0.1):
            balls = zip(feet[above], radii[above], strict=True)
            self.polygons([foot + grown * radius * circle for foot, radius in balls], SHADOW, 0.026 * self.strength, -2)
        if joints:
            ends = dropped(ground.center, ground.normal, np.array(joints).reshape(-1, 3))
            places, scale = self.camera.project(ends)
            path = Path(places, [Path.MOVETO, Path.LINETO] * len(joints))
            width = max(0.5, 2 * self.points * rod * float(scale.mean()))
            style = {"capstyle": "round", "linewidth": width, "alpha": 0.06 * self.strength}
            self.axes.add_patch(PathPatch(path, fill=False, edgecolor=SHADOW, zorder=-2, **style))

    def shadow(self, ground: Ground, faces) -> None:
        """The shadow of a convex solid: its faces that are turned upwards, projected straight down."""
        for corners in faces:
            if outward(corners) @ ground.normal > 0:
                self.polygons([dropped(ground.center, ground.normal, corners)], SHADOW, 0.1 * self.strength, -2)

    def polygons(self, corners, color, alpha: float, zorder: float) -> None:
        """Polygons with equal numbers of corners, in one path: where they overlap they are no darker."""
        if len(corners):
            path = Path.make_compound_path_from_polys(self.camera.project(np.array(corners))[0])
            self.axes.add_patch(PathPatch(path, facecolor=color, linewidth=0, alpha=alpha, zorder=zorder))

"""One moment of a motion in a matplotlib panel, the farthest things first, as in the script of the page."""

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.patches import PathPatch
from matplotlib.path import Path

from vmri_jax import plots
from vmri_jax.animation.camera import Camera
from vmri_jax.animation.layout import Ground, Layout
from vmri_jax.animation.motion import Motion

LAMP = np.array([-0.45, 0.7, 0.55])
"""Where light comes from: right, up, back of the view."""
ROD = {plots.LIGHT: "#8d979f", plots.DARK: "#8b969f"}
SPAN = 0.8
"""Joints end this far into a ball, in its radius."""
LEAD = 0.1
"""Part of a spring that is straight, at each end."""
ON_TOP = 1e9


def draw_moment(
    axes: Axes,
    motion: Motion,
    sizes: Layout,
    camera: Camera,
    aspect: float,
    width: float,
    time: float,
    trail: float,
    theme: plots.Theme,
) -> None:
    """Draw bodies, joints, ground, shadows, and where the bodies were a time `trail` ago; `width` in inches."""
    axes.set(xlim=(-aspect, aspect), ylim=(-1, 1), aspect="equal")
    pen = _Pen(axes, camera, theme, 72 * width / (2 * aspect))
    drawing, points = motion.drawing, motion.at([time])[0]
    paces = {"slow": theme.curves[0], "fast": theme.curves[1]}
    colors = [body.color or paces[body.pace] for body in drawing.bodies]
    ends = [(points[c.body], points[c.other] if c.point is None else c.point) for c in sizes.connections]
    for ground in sizes.grounds:
        pen.ground(ground)
        if ground.normal[2] > 0.5:
            centers = np.concatenate([points, sizes.spheres])
            radii = [*sizes.radii, *(sphere.radius for sphere in drawing.spheres)]
            pen.shadows(ground, centers, radii, ends, sizes.rod)
    for center, sphere in zip(sizes.spheres, drawing.spheres, strict=True):
        pen.ball(center, sphere.radius, theme.faint)
    past = motion.at(np.linspace(max(motion.t[0], time - trail), time, 160))
    for i, color in enumerate(colors):
        pen.trail(past[:, i], color, sizes.radii[i])
    for connection, (a, b) in zip(sizes.connections, ends, strict=True):
        reach = (sizes.radii[connection.body], 0.0 if connection.other is None else sizes.radii[connection.other])
        if connection.kind == "link":
            pen.rod(a, b, reach, sizes.rod, sizes.size)
        else:
            pen.spring(a, b, reach, sizes.coil, sizes.wire, paces[connection.pace], connection.turns)
        if connection.point is not None and np.linalg.norm(a - b) > reach[0]:  # else within the body
            pen.ball(connection.point, 1.5 * sizes.rod, ROD[theme])
    for point, radius, color in zip(points, sizes.radii, colors, strict=True):
        pen.ball(point, radius, color)
    span = float(motion.t[-1] - motion.t[0])
    digits = max(0, 2 - math.floor(math.log10(span))) if span > 0 else 2
    label = f"$t = {time:.{digits}f}$"
    axes.text(-0.97 * aspect, -0.97, label, va="bottom", fontsize=9, color=theme.ink, zorder=ON_TOP)


class _Pen:
    """Draws in a panel, seen by a camera; `points` is the size of a unit of the view in points of print."""

    def __init__(self, axes: Axes, camera: Camera, theme: plots.Theme, points: float):
        self.axes, self.camera, self.theme, self.points = axes, camera, theme, points

    def tone(self, color, shade):
        """A colour from dark (-1) over itself to light (1)."""
        shade = np.atleast_1d(shade)[:, None]
        ends = np.where(shade < 0, 0.06, 1.0)
        return np.array(to_rgb(color)) * (1 - np.abs(shade)) + ends * np.abs(shade)

    def lines(self, ends, colors, widths, zorder: float, **style) -> None:
        """Segments (n, 2, 2); widths in points of print."""
        lines = LineCollection(list(ends), colors=colors, linewidths=np.maximum(0.5, widths), zorder=zorder, **style)
        self.axes.add_collection(lines, autolim=False)

    def ball(self, center, radius: float, color) -> None:
        """Discs that grow lighter towards the lamp; nearer things have a larger scale, and are drawn later."""
        (x, y), scale = self.camera.project(center)
        share = np.linspace(0, 1, int(np.clip(2 * self.points * scale * radius, 12, 60)))
        r = scale * radius * (1 - 0.93 * share)
        shades = np.interp(share, [0, 0.45, 0.8, 1], [-0.42, 0.0, 0.4, 0.75])
        shift = scale * radius * share
        xy = np.stack([x - 0.34 * shift, y + 0.42 * shift], axis=1)
        area = (2 * self.points * r) ** 2
        self.axes.scatter(*xy.T, s=area, c=self.tone(color, shades), linewidths=0, zorder=float(scale))

    def rod(self, a, b, reach, radius: float, size: float) -> None:
        """In pieces, each with its own depth."""
        ends = _joint(a, b, reach)
        if ends is None:
            return
        start, end = ends
        pieces = int(np.clip(np.ceil(10 * np.linalg.norm(end - start) / size), 1, 12))
        places, scale = self.camera.project(start + np.linspace(0, 1, pieces + 1)[:, None] * (end - start))
        along = places[-1] - places[0]
        along /= max(float(np.linalg.norm(along)), 1e-12)
        side = np.array([along[1], -along[0]])
        side *= 1.0 if side @ LAMP[:2] > 0 else -1.0
        overlap = 0.3 / self.points * np.array([-along, along])  # or seams would show
        tones = self.tone(ROD[self.theme], [-0.35, 0.05, 0.5])
        for k in range(pieces):
            w = radius * (scale[k] + scale[k + 1])
            middle = float(scale[k] + scale[k + 1]) / 2
            shifts = np.array([0.0, 0.12, 0.25])[:, None, None] * w * side
            widths = self.points * np.array([1.0, 0.72, 0.25]) * w
            self.lines(places[[k, k + 1]] + overlap + shifts, tones, widths, middle, capstyle="butt")

    def spring(self, a, b, reach, coil: float, wire: float, color, turns: int) -> None:
        """A helix with straight ends."""
        ends = _joint(a, b, reach)
        if ends is None:
            return
        start, end = ends
        along = (end - start) / np.linalg.norm(end - start)
        sideways = np.cross(along, [0.36, 0.48, 0.8])
        sideways /= np.linalg.norm(sideways)
        turn = np.linspace(0, turns, 16 * turns + 1)[:, None]
        grown = np.minimum(1, np.minimum(turn, turns - turn))
        radial = np.cos(2 * np.pi * turn) * sideways + np.sin(2 * np.pi * turn) * np.cross(along, sideways)
        helix = start + (LEAD + (1 - 2 * LEAD) * turn / turns) * (end - start) + coil * grown * radial
        places, scale = self.camera.project(np.concatenate([start[None], helix, end[None]]))
        bright = 0.45 * (radial @ self.camera.axes.T) @ LAMP
        shades = np.concatenate([[0.0], bright[1:], [0.0]])
        order = np.argsort(scale[:-1] + scale[1:])
        segments = np.stack([places[:-1], places[1:]], axis=1)
        widths = self.points * wire * (scale[:-1] + scale[1:])
        tones = self.tone(color, shades)
        self.lines(segments[order], tones[order], widths[order], float(scale.mean()), capstyle="round")

    def trail(self, path, color, radius: float) -> None:
        """Fading into the past, from the surface of the ball on."""
        outside = np.linalg.norm(path - path[-1], axis=1) >= 0.9 * radius
        path = path[: len(path) - int(np.argmax(outside[::-1]))] if outside.any() else path[:0]
        if len(path) < 2:
            return
        places, scale = self.camera.project(path)
        young = np.linspace(0, 1, len(path) - 1)
        segments = np.stack([places[:-1], places[1:]], axis=1)
        behind = 0.998 * float(scale.mean())
        self.lines(segments, color, 0.5 + 0.9 * young, behind, alpha=0.7 * young**1.5, capstyle="butt")

    def ground(self, ground: Ground) -> None:
        """A grid that fades outwards; a solid plane is tinted too."""
        segments, strengths = [], []
        for across in (0, 1):
            along, beside = ground.halves[1 - across], ground.halves[across]
            count = int(beside / ground.step)
            for k in range(-count, count + 1):
                w = np.linspace(-along, along, 17)
                uv = np.stack([np.full(17, k * ground.step), w], axis=1)[:, :: -1 if across else 1]
                line = ground.center + uv @ ground.sides
                segments.append(np.stack([line[:-1], line[1:]], axis=1))
                middle = (uv[:-1] + uv[1:]) / 2 / ground.halves
                fade = np.clip(1 - np.linalg.norm(middle, axis=1), 0, 1)
                strengths.append(np.ones(16) if ground.solid else fade)
        places, scale = self.camera.project(np.concatenate(segments))
        seen = (scale > 0).all(axis=1)
        self.lines(places[seen], self.theme.faint, 0.7, -3, alpha=np.concatenate(strengths)[seen])
        if ground.solid:
            corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * ground.halves
            self.polygons([ground.center + corners @ ground.sides], self.theme.faint, 0.4, -4)

    def shadows(self, ground: Ground, points, radii, joints, rod: float) -> None:
        """Straight down onto a plane that bears; where those of a kind overlap they are no darker."""
        angle = np.linspace(0, 2 * np.pi, 25)[:-1]
        circle = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ ground.sides
        color, strength = "#000000", 1.0 if self.theme is plots.LIGHT else 2.0
        for grown in np.arange(0.7, 1.5, 0.1):
            rings = [
                _dropped(ground, point) + grown * radius * circle
                for point, radius in zip(points, radii, strict=True)
                if (point - ground.center) @ ground.normal > 0
            ]
            self.polygons(rings, color, 0.026 * strength, -2)
        if joints:
            ends = np.array([[_dropped(ground, a), _dropped(ground, b)] for a, b in joints]).reshape(-1, 3)
            places, scale = self.camera.project(ends)
            path = Path(places, [Path.MOVETO, Path.LINETO] * len(joints))
            width = max(0.5, 2 * self.points * rod * float(scale.mean()))
            style = {"capstyle": "round", "linewidth": width, "alpha": 0.06 * strength}
            self.axes.add_patch(PathPatch(path, fill=False, edgecolor=color, zorder=-2, **style))

    def polygons(self, corners, color, alpha: float, zorder: float) -> None:
        """Of as many corners each, in one path."""
        if len(corners):
            path = Path.make_compound_path_from_polys(self.camera.project(np.array(corners))[0])
            self.axes.add_patch(PathPatch(path, facecolor=color, linewidth=0, alpha=alpha, zorder=zorder))


def _joint(a, b, reach):
    """Where a joint of two balls starts and ends; None if they touch or an end lies within the other ball."""
    gap = b - a
    length = float(np.linalg.norm(gap))
    if length <= max(SPAN * sum(reach), *reach):
        return None
    return a + SPAN * reach[0] / length * gap, b - SPAN * reach[1] / length * gap


def _dropped(ground: Ground, point):
    """The point straight below on the plane."""
    return point + np.array([0.0, 0.0, (ground.center - point) @ ground.normal / ground.normal[2]])

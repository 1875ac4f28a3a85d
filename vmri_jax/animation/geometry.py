"""Shapes at rest, as points: what strips, GIFs and the page have in common.

Grids and helices are computed here once; the page gets them as numbers. What depends on time (where a joint ends, a helix
between two bodies) is computed by the script of the page at play time, from the same numbers: every node of a long run
with every turn of its springs would make a page of many megabytes.
"""

import numpy as np

LAMP = (-0.45, 0.7, 0.55)
"""Where light comes from: right, up, back of the view."""
SPAN = 0.8
"""Joints end this far into a ball, in its radius."""
LEAD = 0.1
"""Part of a spring that is straight, at each end."""
PIECES = 16
"""Of a line of a grid, each with its own strength."""


def helix(turns: int, per_turn: int = 16) -> np.ndarray:
    """A spring that keeps its turns when it stretches: one row (share, radius, cos, sin) per point.

    The point of a row is ``start + share (end - start) + radius coil (cos n + sin m)``, n and m unit vectors across.

    Args:
        turns: how many.
        per_turn: points in each.
    """
    turn = np.arange(turns * per_turn + 1) / per_turn
    radius = np.minimum(1, np.minimum(turn, turns - turn))
    share = LEAD + (1 - 2 * LEAD) * turn / turns
    return np.stack([share, radius, np.cos(2 * np.pi * turn), np.sin(2 * np.pi * turn)], axis=1)


def grid(center, sides, halves: tuple[float, float], step: float, fades: bool) -> np.ndarray:
    """Pieces of the lines of a grid on a rectangle: one row (from, to, strength) of seven numbers each.

    Args:
        center, sides: (3,) and (2, 3), middle and unit vectors along the sides.
        halves: half lengths of the sides.
        step: between two lines.
        fades: strengths fall to zero outwards, from 1 in the middle; else all are 1.
    """
    rows = []
    for across in (0, 1):
        along, beside = halves[1 - across], halves[across]
        count = int(beside / step)
        for k in range(-count, count + 1):
            w = np.linspace(-along, along, PIECES + 1)
            uv = np.stack([np.full(PIECES + 1, k * step), w], axis=1)[:, :: -1 if across else 1]
            line = center + uv @ sides
            outwards = np.linalg.norm((uv[:-1] + uv[1:]) / 2 / halves, axis=1)
            strength = np.clip(1 - outwards, 0, 1) if fades else np.ones(PIECES)
            rows.append(np.concatenate([line[:-1], line[1:], strength[:, None]], axis=1))
    found = np.concatenate(rows)
    return found[found[:, 6] > 0]


def joint(a, b, reach: tuple[float, float]):
    """Where a joint of two balls starts and ends; None if they touch or an end lies within the other ball.

    Args:
        a, b: (3,) centres.
        reach: their radii.
    """
    gap = b - a
    length = float(np.linalg.norm(gap))
    if length <= max(SPAN * sum(reach), *reach):
        return None
    return a + SPAN * reach[0] / length * gap, b - SPAN * reach[1] / length * gap


def spring(start, end, coil: float, turns: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) of a helix with straight ends, and how they lie off its axis, in radii.

    Args:
        start, end: (3,).
        coil: radius of the helix.
        turns: how many.
    """
    along = (end - start) / np.linalg.norm(end - start)
    sideways = np.cross(along, [0.36, 0.48, 0.8])
    sideways /= np.linalg.norm(sideways)
    share, radius, cos, sin = helix(turns).T[:, :, None]
    radial = cos * sideways + sin * np.cross(along, sideways)
    turning = start + share * (end - start) + coil * radius * radial
    return np.concatenate([start[None], turning, end[None]]), radial


def dropped(center, normal, points) -> np.ndarray:
    """The points (n, 3) straight below others on a plane that is not upright."""
    height = (center - points) @ normal / normal[2]
    return points + height[:, None] * np.array([0.0, 0.0, 1.0])

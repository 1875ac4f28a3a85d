"""General coordinates as bars: balls at their heights over a base line."""

import math
from dataclasses import replace

import numpy as np

from vmri_jax.animation.drawing import Drawing, check_index
from vmri_jax.animation.parts import Body, Joint
from vmri_jax.running.trajectory import Trajectory

BALL_RADIUS = 0.24
"""Radius of the ball on a bar, over the distance between bars: below a half, else neighbours touch."""


def bars(trajectory: Trajectory) -> dict:
    """A drawing of any run: all coordinates of q_s, and all of q_f, as bars.

    Args:
        trajectory: one run.

    Returns:
        Plain data for `Drawing.from_dict`.
    """
    names = trajectory.names
    parts = (("s", names.slow_coordinates), ("f", names.fast_coordinates))
    blocks = [
        {"name": f"q_{part}", "coordinates": [[part, i] for i in range(len(labels))], "labels": labels}
        for part, labels in parts
        if labels
    ]
    return {"blocks": blocks}


def with_bars(drawing: Drawing, q_s: np.ndarray, q_f: np.ndarray) -> Drawing:
    """The drawing with a body for each coordinate of its blocks, right of all others; q (k, n) along the run.

    Each block has a scale, 1, 2 or 5 times a power of ten, with which its largest coordinate in the run just fits the
    height of the bars; the caption tells the scales.
    """
    if not drawing.blocks:
        return drawing
    values = {"s": q_s, "f": q_f}
    for block in drawing.blocks:
        for part, i in block.coordinates:
            check_index(block.name, part, i, q_s.shape[1], q_f.shape[1])
    corner, height = _room(drawing, q_s, q_f)
    unit = height / max(2.0, 0.22 * sum(len(block.coordinates) for block in drawing.blocks))
    axes = drawing.frame(max(2, drawing.dimension))
    bodies, posts, scales, x = [], [], [], 0.0
    for block in drawing.blocks:
        largest = max(float(np.abs(values[part][:, i]).max()) for part, i in block.coordinates)
        scale = _round(height / largest) if largest > 0 else 1.0
        scales.append(f"{block.name} times {scale:g}")
        for label, coordinate in zip(block.labels, block.coordinates, strict=True):
            foot = tuple(((corner + np.array([x, 0.0, 0.0])) @ axes).tolist())
            forms = tuple(((scale * float(weight), *coordinate),) if weight else () for weight in axes[2])
            bodies.append(Body(label, forms, foot, BALL_RADIUS * unit))
            posts.append(Joint("link", (bodies[-1].name,), foot))
            x += unit
        x += unit
    heights = f"Heights are {', '.join(scales[:-1])}{' and ' if scales[:-1] else ''}{scales[-1]}."
    return replace(
        drawing,
        bodies=(*drawing.bodies, *bodies),
        blocks=(),
        joints=(*drawing.joints, *posts),
        caption=f"{drawing.caption} {heights}".strip(),
    )


def _room(drawing: Drawing, q_s: np.ndarray, q_f: np.ndarray) -> tuple[np.ndarray, float]:
    """Foot (3,) of the first bar in the picture, and the largest height of bars, up and down."""
    if not drawing.bodies:
        return np.zeros(3), 2.0
    offset, matrix = drawing.maps(q_s.shape[1], q_f.shape[1])
    points = (offset + np.einsum("iaq,kq->kia", matrix, np.concatenate([q_s, q_f], axis=1))).reshape(-1, 3)
    low, high = points.min(axis=0), points.max(axis=0)
    height = float(np.linalg.norm(high - low)) / 3 or 1.0
    return np.array([high[0] + height, *(low + high)[1:] / 2]), height


def _round(x: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above x."""
    power = 10.0 ** math.floor(math.log10(x))
    return max(digit * power for digit in (1, 2, 5) if digit * power <= x * (1 + 1e-12))

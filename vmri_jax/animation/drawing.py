"""The drawing of a system: its parts, where they are for given coordinates, and plain data that is stored next to a
run."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax
import numpy as np

from vmri_jax.animation.parts import PACES, Block, Body, Joint, Plane, Solid, Sphere, read_drawing
from vmri_jax.mechanics.kinematics import Kinematics
from vmri_jax.refusals import Refused
from vmri_jax.running.trajectory import Trajectory

BALL_RADIUS = 0.24
"""Radius of the ball on a bar, over the distance between bars: below a half, else neighbours touch."""


@dataclass(frozen=True)
class Drawing:
    """The picture of a system: bodies, solids, blocks of general coordinates, joints between bodies, fixed planes and
    spheres.

    Attributes:
        up: the direction that points upwards in the picture, in coordinates of the bodies; None for the last coordinate
            (bodies of one coordinate move sideways).
        view: azimuth and elevation of the camera, in degrees; None for a view that depends on the dimension. (-90, 0)
            is from the front, with x to the right; (-90, 90) from above.
        caption: a line of text for the picture.
        carried: for runs in joint coordinates, the map from the coordinates of the run to the coordinates of the
            bodies, and the arrays of its joints, see `vmri_jax.mechanics.kinematics`; else None.
    """

    bodies: tuple[Body, ...]
    blocks: tuple[Block, ...] = ()
    solids: tuple[Solid, ...] = ()
    joints: tuple[Joint, ...] = ()
    planes: tuple[Plane, ...] = ()
    spheres: tuple[Sphere, ...] = ()
    up: tuple[float, ...] | None = None
    view: tuple[float, ...] | None = None
    caption: str = ""
    carried: tuple[Kinematics, dict[str, np.ndarray]] | None = None

    @classmethod
    def from_dict(cls, data: Any) -> "Drawing":
        """A drawing from plain data, checked.

        Args:
            data: a dict (or its JSON text) of

                - ``bodies``: dicts of ``name``; ``coordinates``, 1 to 3 entries ``["s" or "f", index]``, or linear
                  forms ``[[weight, "s" or "f", index], ...]``; optionally ``offset``, ``radius``, ``color``, ``shown``.
                - ``solids``: dicts of ``name``; ``coordinates`` of a rigid body, its centre and its directors;
                  ``corners``, along the directors; ``faces``; optionally ``color``.
                - ``blocks``: dicts of ``name``; ``coordinates``, any number of entries ``["s" or "f", index]``;
                  optionally ``labels``, a name for each coordinate.
                - ``links``, ``springs``: pairs of names, with an optional third entry "slow" or "fast".
                - ``anchors``: dicts of ``body``, ``point``, ``kind`` ("link" or "spring"), optionally ``pace``.
                - ``planes``: dicts of ``point``, ``normal``; ``spheres``: dicts of ``center``, ``radius``.
                - ``up``, ``view``, ``caption``: see above; ``kinematics``: "map" and "joints" of `carried`, which a
                  scene writes.

        Raises:
            ValueError: other data; the message names the wrong entry.
        """
        return cls(**read_drawing(data))

    def extended(self, q_s, q_f, v_s, v_f) -> tuple[np.ndarray, ...]:
        """Coordinates of the bodies and their rates, slow and fast, (k, n) each, for coordinates and rates of a run."""
        if self.carried is None:
            return q_s, q_f, v_s, v_f
        kinematics, joints = self.carried

        def bodies_and_rates(q_s, q_f, v_s, v_f):
            return *kinematics(q_s, q_f, joints), *kinematics.velocities(q_s, q_f, v_s, v_f, joints)

        return tuple(map(np.asarray, jax.jit(jax.vmap(bodies_and_rates))(q_s, q_f, v_s, v_f)))

    @cached_property
    def numbers(self) -> dict[str, int]:
        """Numbers of the bodies by name."""
        return {body.name: i for i, body in enumerate(self.bodies)}

    def ends(self, joint: Joint, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The two points (..., 3) that a joint joins, from the positions (..., n_bodies, 3) of the bodies."""
        body, *other = (points[..., self.numbers[name], :] for name in joint.bodies)
        return body, self.place([joint.point])[0] if joint.point is not None else other[0]

    def length(self, joint: Joint, points: np.ndarray) -> np.ndarray:
        """(...) distance of the ends of a joint."""
        return np.linalg.norm(np.subtract(*self.ends(joint, points)), axis=-1)

    def corners(self, points: np.ndarray) -> list[np.ndarray]:
        """Corners (..., n, 3) of each solid, from the positions (..., n_bodies, 3) of the bodies."""
        solids = []
        for solid in self.solids:
            # x_0 + sum_i c_i (x_i - x_0)
            centre, *ends = (points[..., self.numbers[name], :] for name in solid.points)
            axes = np.stack([end - centre for end in ends], axis=-2)
            solids.append(centre[..., None, :] + np.array(solid.corners) @ axes)
        return solids

    def pace(self, joint: Joint) -> str:
        """ "slow" or "fast": the pace of the joint if it has one, else "fast" if all its bodies are fast."""
        fast = all(body.pace == "fast" for body in self.bodies if body.name in joint.bodies)
        return joint.pace or ("fast" if fast else "slow")

    @property
    def paces(self) -> list[str]:
        """Paces of the bodies and springs, "slow" before "fast"."""
        paces = {body.pace for body in self.bodies}
        paces |= {self.pace(joint) for joint in self.joints if joint.kind == "spring"}
        return [pace for pace in PACES if pace in paces]

    @property
    def dimension(self) -> int:
        """Number of coordinates of a point: 1, 2 or 3, the largest number of any body, point or direction of the
        drawing."""
        points = [joint.point or () for joint in self.joints] + [sphere.center for sphere in self.spheres]
        points += [vector for plane in self.planes for vector in (plane.point, plane.normal)]
        points += [vector for body in self.bodies for vector in (body.forms, body.offset)] + [self.up or ()]
        return max((len(point) for point in points), default=1)

    def frame(self, dimension: int | None = None) -> np.ndarray:
        """(3, dimension) matrix of orthonormal columns from coordinates of the bodies to coordinates of the picture,
        see `up`; in the dimension of the drawing by default."""
        dimension = dimension or self.dimension
        if self.up is None:
            return np.array([[1.0], [0.0], [0.0]]) if dimension == 1 else _upright(np.eye(dimension)[-1])
        padded = np.pad(self.up, (0, dimension - len(self.up)))
        return _upright(padded / np.linalg.norm(padded))

    def place(self, points: Sequence[tuple[float, ...]]) -> np.ndarray:
        """(n, 3) points or directions in coordinates of the picture; missing coordinates of the given ones are zero."""
        d = self.dimension
        padded = np.array([np.pad(point, (0, d - len(point))) for point in points]).reshape(-1, d)
        return padded @ self.frame().T

    def maps(self, n_s: int, n_f: int) -> tuple[np.ndarray, np.ndarray]:
        """Offset (n, 3) and matrix (n, 3, n_s + n_f) of the positions of the bodies in the picture,
        ``offset + matrix @ q`` with n_s slow and n_f fast coordinates, as of `extended`.

        Raises:
            ValueError: a body uses a coordinate that q does not have.
        """
        first = {"s": 0, "f": n_s}
        matrix = np.zeros((len(self.bodies), self.dimension, n_s + n_f))
        for i, body in enumerate(self.bodies):
            for axis, form in enumerate(body.forms):
                for weight, part, index in form:
                    check_index(body.name, part, index, n_s, n_f)
                    matrix[i, axis, first[part] + index] += weight
        return self.place([body.offset for body in self.bodies]), np.einsum("ad,idq->iaq", self.frame(), matrix)


def check_index(name: str, part: str, index: int, n_s: int, n_f: int) -> None:
    """Refuse a coordinate of a body or block that the run does not have."""
    size, pace = (n_s, "slow") if part == "s" else (n_f, "fast")
    if index >= size:
        raise Refused(
            f"drawing: the body {name!r} uses [{part!r}, {index}], but the run has {size} {pace} coordinates; is this "
            "the drawing of another system?"
        )


def _upright(up: np.ndarray) -> np.ndarray:
    """Matrix of a rotation that takes the unit vector `up` to z, and leaves the x axis in place if it is at a right
    angle to `up`."""
    if up.size == 1:
        return np.array([[0.0], [0.0], [up[0]]])
    if up.size == 2:
        return np.array([[up[1], -up[0]], [0.0, 0.0], up])
    # Gram-Schmidt from the x axis, or from the y axis if `up` is nearly along x
    x = np.eye(3)[0 if abs(up[0]) < 0.9 else 1]
    x = x - (x @ up) * up
    x /= np.linalg.norm(x)
    return np.array([x, np.cross(up, x), up])


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

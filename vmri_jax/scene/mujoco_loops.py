"""The equalities connect and weld of a model of MuJoCo, which close its loops: where both ends are, and how far apart.

MuJoCo keeps equalities softly. A start that it has come to has gaps, for a scene to close: Newton's iteration on its coordinates,

    J dq = -r,    r = (x_1 - x_2, rotation vector of R_1 R_2^T),    J = (J_x1 - J_x2, J_w1 - J_w2),

with the points x and frames R of both ends (frames of welds only) and their Jacobians; ``dq`` is the smallest solution.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from vmri_jax.scene.mujoco_model import Compiled

WIDEST = 1e-3
"""Gap, in extents of the model or rad, up to which a start is moved to close its loops: MuJoCo's softness leaves some 1e-4. A
start that is further open has another shape than the file says, and no nearest closed one that its author would expect."""
CLOSED = 1e-13
"""Gap, likewise, that is round-off: Newton's iteration ends there."""
LEFT = 1e-6
"""Gap, likewise, that may be left: files have about seven digits, and what these leave open no motion of the joints can close."""
ITERATIONS = 50
"""Most iterations; about three are needed, and 20 for a start where the Jacobian loses rank."""


class End(NamedTuple):
    """One end of an equality: the body, and point (3,) and frame (3, 3) in space."""

    body: int
    point: np.ndarray
    frame: np.ndarray


class Loop(NamedTuple):
    """An equality that acts.

    Attributes:
        number: in the model.
        welded: a weld, which keeps frames together too.
        ends: both of them.
    """

    number: int
    welded: bool
    ends: tuple[End, End]

    @property
    def gap(self) -> np.ndarray:
        """Points apart, m, (3,); of a weld and then frames apart, rad, (6,)."""
        first, second = self.ends
        apart = first.point - second.point
        if not self.welded:
            return apart
        return np.concatenate([apart, Rotation.from_matrix(first.frame @ second.frame.T).as_rotvec()])


def loops(compiled: Compiled, data: Any) -> list[Loop]:
    """The connects and welds that act between bodies that can move against each other.

    Args:
        compiled: the model.
        data: `mujoco.MjData` after its kinematics.
    """
    found = []
    for i in compiled.equalities:
        if compiled.closes(i):
            ends = _ends(compiled, data, i)
            if compiled.group(ends[0].body) != compiled.group(ends[1].body):
                found.append(Loop(i, compiled.model.eq_type[i] == compiled.mujoco.mjtEq.mjEQ_WELD, ends))
    return found


def close(compiled: Compiled, data: Any) -> None:
    """Move joints so that small gaps close, in place.

    Args:
        compiled, data: as of `loops`.

    Raises:
        ValueError: a loop that is open, or does not close.
    """
    model, mujoco, extent = compiled.model, compiled.mujoco, float(compiled.model.stat.extent)
    _refuse(compiled, loops(compiled, data), WIDEST, "is open at the start by")
    for _ in range(ITERATIONS):
        open_ones = loops(compiled, data)
        if not open_ones or max(_size(loop, extent) for loop in open_ones) <= CLOSED:
            return
        jacobian = np.concatenate([_jacobian(compiled, data, loop) for loop in open_ones])
        gaps = np.concatenate([loop.gap for loop in open_ones])
        mujoco.mj_integratePos(model, data.qpos, np.linalg.lstsq(jacobian, -gaps, rcond=1e-10)[0], 1.0)
        mujoco.mj_forward(model, data)
    _refuse(compiled, loops(compiled, data), LEFT, "does not close; what stays open is")


def _refuse(compiled: Compiled, several: list[Loop], most: float, how: str) -> None:
    """Raise ValueError where one of them is open by more than this."""
    extent = float(compiled.model.stat.extent)
    far = [loop for loop in several if _size(loop, extent) > most]
    if not far:
        return
    gaps = []
    for loop in far:
        apart = np.linalg.norm(loop.gap.reshape(-1, 3), axis=1)
        turned = f" and {apart[1]:.3g} rad" if loop.welded else ""
        gaps.append(f"{compiled.name('equality', loop.number)} {how} {apart[0]:.3g} m{turned}")
    raise ValueError(
        f"Scene.from_mujoco: {'; '.join(gaps)}. Here equalities hold exactly: give a qpos where they do, as one at which MuJoCo's "
        "simulation comes to rest, or switch the equality off in the model."
    )


def _size(loop: Loop, extent: float) -> float:
    """The gap of a loop in extents of the model or rad."""
    apart = np.linalg.norm(loop.gap.reshape(-1, 3), axis=1)
    return float(np.max(apart / [extent, 1.0][: len(apart)]))


def _ends(compiled: Compiled, data: Any, i: int) -> tuple[End, End]:
    """Both ends of an equality, as MuJoCo's engine has them."""
    model = compiled.model
    objects = int(model.eq_obj1id[i]), int(model.eq_obj2id[i])
    if model.eq_objtype[i] == compiled.mujoco.mjtObj.mjOBJ_SITE:
        first, second = (
            End(int(model.site_bodyid[s]), data.site_xpos[s].copy(), data.site_xmat[s].reshape(3, 3).copy())
            for s in objects
        )
        return first, second
    in_first, in_second, turned = model.eq_data[i, :3], model.eq_data[i, 3:6], np.eye(3)
    if (
        model.eq_type[i] == compiled.mujoco.mjtEq.mjEQ_WELD
    ):  # anchor in the second body, pose of the second in the first
        in_first, in_second = in_second, in_first
        turned = Rotation.from_quat(model.eq_data[i, 6:10], scalar_first=True).as_matrix()
    frames = [data.xmat[b].reshape(3, 3).copy() for b in objects]
    points = [
        data.xpos[b] + frame @ point for b, frame, point in zip(objects, frames, (in_first, in_second), strict=True)
    ]
    return End(objects[0], points[0], frames[0] @ turned), End(objects[1], points[1], frames[1])


def _jacobian(compiled: Compiled, data: Any, loop: Loop) -> np.ndarray:
    """Of the gap by MuJoCo's velocities, (3 or 6, nv)."""
    sides = []
    for end in loop.ends:
        moved, turned = np.zeros((3, compiled.model.nv)), np.zeros((3, compiled.model.nv))
        compiled.mujoco.mj_jac(compiled.model, data, moved, turned, end.point, end.body)
        sides.append(np.concatenate([moved, turned]) if loop.welded else moved)
    return sides[0] - sides[1]

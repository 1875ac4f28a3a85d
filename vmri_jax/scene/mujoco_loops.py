"""The equalities connect and weld of a model of MuJoCo, which close its loops: both ends of each, and the gap between them.

MuJoCo's equalities are soft, so that a configuration from a simulation of MuJoCo has gaps. Newton's iteration on MuJoCo's coordinates
closes them,

    J dq = -r,    r = (x_1 - x_2, rotation vector of R_1 R_2^T),    J = (J_x1 - J_x2, J_w1 - J_w2),

with the points x and frames R of both ends (frames of welds only) and their Jacobians; ``dq`` is the shortest solution.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from vmri_jax.scene.mujoco_model import Compiled

WIDEST_GAP = 1e-3
"""Widest gap that the reader closes, in extents of the model or rad; MuJoCo's softness leaves some 1e-4. To close a wider gap joints would
move so far that the start has another shape than in the file."""
ROUND_OFF_GAP = 1e-13
"""Gap that is round-off, in extents of the model or rad: Newton's iteration ends there. A larger value leaves wider gaps in the scene."""
WIDEST_LEFT = 1e-6
"""Widest gap after the iteration, in extents of the model or rad. Files have about seven digits, and in planar loops no motion of the
joints closes a gap out of the plane. A larger value accepts loops that do not fit."""
ITERATIONS = 50
"""Most iterations; about three are needed, and 20 at a start where the Jacobian loses rank. More only delay the error message."""
RANK = 1e-10
"""Singular values of the Jacobian below this fraction of the largest count as zero, so that dependent rows do no harm. A larger value
ignores motions that close a gap."""


class End(NamedTuple):
    """An end of an equality: number of its body, and its point (3,) and frame (3, 3) in space."""

    body: int
    point: np.ndarray
    frame: np.ndarray


class Loop(NamedTuple):
    """An equality connect or weld.

    Attributes:
        number: of the equality in the model.
        welded: whether it is a weld, which holds the frames of both ends together, too.
        ends: both ends.
    """

    number: int
    welded: bool
    ends: tuple[End, End]

    @property
    def gap(self) -> np.ndarray:
        """r of the module: (3,) m between the points; of a weld (6,), followed by the rotation vector between the frames, rad."""
        first, second = self.ends
        distance = first.point - second.point
        if not self.welded:
            return distance
        return np.concatenate([distance, Rotation.from_matrix(first.frame @ second.frame.T).as_rotvec()])


def loops(compiled: Compiled, data: Any) -> list[Loop]:
    """The active equalities connect and weld between bodies that can move against each other."""
    closed = []
    for i in compiled.equalities:
        if compiled.closes(i):
            ends = _ends(compiled, data, i)
            if compiled.group(ends[0].body) != compiled.group(ends[1].body):
                closed.append(Loop(i, compiled.model.eq_type[i] == compiled.mujoco.mjtEq.mjEQ_WELD, ends))
    return closed


def close(compiled: Compiled, data: Any) -> None:
    """Move joints so that small gaps close, in place; refuse wide gaps."""
    model, mujoco, extent = compiled.model, compiled.mujoco, float(compiled.model.stat.extent)
    _refuse_gaps(compiled, loops(compiled, data), WIDEST_GAP, "is open at the start by")
    for _ in range(ITERATIONS):
        closing = loops(compiled, data)
        if not closing or max(_size(loop, extent) for loop in closing) <= ROUND_OFF_GAP:
            return
        jacobian = np.concatenate([_jacobian(compiled, data, loop) for loop in closing])
        gaps = np.concatenate([loop.gap for loop in closing])
        mujoco.mj_integratePos(model, data.qpos, np.linalg.lstsq(jacobian, -gaps, rcond=RANK)[0], 1.0)
        mujoco.mj_forward(model, data)
    _refuse_gaps(compiled, loops(compiled, data), WIDEST_LEFT, "does not close; its remaining gap is")


def _refuse_gaps(compiled: Compiled, closing: list[Loop], widest: float, phrase: str) -> None:
    """Raise ValueError if a loop has a gap above `widest`; the message says "{name} {phrase} {gap}"."""
    extent = float(compiled.model.stat.extent)
    gaps = []
    for loop in closing:
        if _size(loop, extent) > widest:
            distances = np.linalg.norm(loop.gap.reshape(-1, 3), axis=1)
            angle = f" and {distances[1]:.3g} rad" if loop.welded else ""
            gaps.append(f"{compiled.name('equality', loop.number)} {phrase} {distances[0]:.3g} m{angle}")
    if not gaps:
        return
    raise ValueError(
        f"Scene.from_mujoco: {'; '.join(gaps)}. Here equalities hold exactly: give a qpos where they do, as one at which MuJoCo's "
        "simulation comes to rest, or switch the equality off in the model."
    )


def _size(loop: Loop, extent: float) -> float:
    """The gap of a loop, in extents of the model or rad."""
    distances = np.linalg.norm(loop.gap.reshape(-1, 3), axis=1)
    return float(np.max(distances / [extent, 1.0][: len(distances)]))


def _ends(compiled: Compiled, data: Any, i: int) -> tuple[End, End]:
    """Both ends of an equality, as MuJoCo's engine defines them."""
    model = compiled.model
    objects = int(model.eq_obj1id[i]), int(model.eq_obj2id[i])
    if model.eq_objtype[i] == compiled.mujoco.mjtObj.mjOBJ_SITE:
        first, second = (
            End(int(model.site_bodyid[s]), data.site_xpos[s].copy(), data.site_xmat[s].reshape(3, 3).copy())
            for s in objects
        )
        return first, second
    in_first, in_second, rotation = model.eq_data[i, :3], model.eq_data[i, 3:6], np.eye(3)
    if model.eq_type[i] == compiled.mujoco.mjtEq.mjEQ_WELD:
        # eq_data of a weld: anchor in the second body, then position and quaternion of the second body in the first
        in_first, in_second = in_second, in_first
        rotation = Rotation.from_quat(model.eq_data[i, 6:10], scalar_first=True).as_matrix()
    frames = [data.xmat[b].reshape(3, 3).copy() for b in objects]
    points = [
        data.xpos[b] + frame @ point for b, frame, point in zip(objects, frames, (in_first, in_second), strict=True)
    ]
    return End(objects[0], points[0], frames[0] @ rotation), End(objects[1], points[1], frames[1])


def _jacobian(compiled: Compiled, data: Any, loop: Loop) -> np.ndarray:
    """The Jacobian of the gap with respect to MuJoCo's velocities, (3, nv), of a weld (6, nv)."""
    sides = []
    for end in loop.ends:
        of_point, of_rotation = np.zeros((3, compiled.model.nv)), np.zeros((3, compiled.model.nv))
        compiled.mujoco.mj_jac(compiled.model, data, of_point, of_rotation, end.point, end.body)
        sides.append(np.concatenate([of_point, of_rotation]) if loop.welded else of_point)
    return sides[0] - sides[1]

"""The equalities of a model of MuJoCo: connect and weld, which close loops, and couplings of two joints or of two fixed
tendons.

MuJoCo's equalities are soft, so that a configuration from a simulation of MuJoCo has gaps. Newton's iteration on
MuJoCo's coordinates closes the gaps of loops,

    J dq = -r,    r = (x_1 - x_2, rotation vector of R_1 R_2^T),    J = (J_x1 - J_x2, J_w1 - J_w2),

with the points x and frames R of both ends (frames of welds only) and their Jacobians; ``dq`` is the shortest solution.

A coupling is a polynomial,

    y - y_0 = a_0 + a_1 (x - x_0) + ... + a_4 (x - x_0)^4.

y and x are the coordinates of the joints, or the lengths of the tendons: sums of joint coordinates with constant
ratios. y_0 and x_0 are their values at qpos0. Without a second joint or tendon the equality is ``y = y_0 + a_0``.

Source: MuJoCo's documentation, "XML reference", equality.
"""

from collections.abc import Iterator
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from vmri_jax.refusals import Refused
from vmri_jax.scene.effects.joint_effects import JointCoupling
from vmri_jax.scene.mujoco_model import Compiled

WIDEST_GAP = 1e-3
"""Widest gap that the reader closes, in extents of the model or rad; MuJoCo's softness leaves some 1e-4. To close a
wider gap joints would move so far that the start has another shape than in the file."""
ROUND_OFF_GAP = 1e-13
"""Gap that is round-off, in extents of the model or rad: Newton's iteration ends there.

A larger value leaves wider gaps in the scene.
"""
WIDEST_LEFT = 1e-6
"""Widest gap after the iteration, in extents of the model or rad. Files have about seven digits, and in planar loops no
motion of the joints closes a gap out of the plane. A larger value accepts loops that do not fit."""
ITERATIONS = 50
"""Most iterations; about three are needed, and 20 at a start where the Jacobian loses rank.

More only delay the error message.
"""
RANK = 1e-10
"""Singular values of the Jacobian below this fraction of the largest count as zero, so that dependent rows do no harm.
A larger value ignores motions that close a gap."""
ADVICE = (
    "Here equalities hold exactly: give a qpos where they do, as one at which MuJoCo's simulation comes to rest, or "
    "switch the equality off in the model."
)
"""End of messages about equalities that the start violates."""


class Loop(NamedTuple):
    """An active equality connect, or weld, between bodies that can move against each other.

    number: in the model.
    bodies: numbers of both.
    points: (2, 3) of both ends in space.
    gap: r of the module: (1, 3) m between the points; of a weld (2, 3), followed by the rotation vector between the
        frames, rad.
    """

    number: int
    bodies: list[int]
    points: np.ndarray
    gap: np.ndarray


def loops(compiled: Compiled) -> list[Loop]:
    """The loops at the positions in the data, with ends as MuJoCo's engine defines them."""
    model, data, closed = compiled.model, compiled.data, []
    for i in filter(compiled.closes, compiled.equalities):
        bodies = [int(model.eq_obj1id[i]), int(model.eq_obj2id[i])]
        is_weld = model.eq_type[i] == compiled.mujoco.mjtEq.mjEQ_WELD
        if model.eq_objtype[i] == compiled.mujoco.mjtObj.mjOBJ_SITE:
            sites, bodies = bodies, model.site_bodyid[bodies].tolist()
            points, frames = data.site_xpos[sites], data.site_xmat[sites].reshape(2, 3, 3)
        else:
            # eq_data of a weld: anchor in the second body, then position and quaternion of the second body in the first
            anchors = model.eq_data[i, :6].reshape(2, 3)[:: -1 if is_weld else 1]
            frames = data.xmat[bodies].reshape(2, 3, 3)
            points = data.xpos[bodies] + (frames @ anchors[..., None])[..., 0]
            if is_weld:
                frames[0] @= Rotation.from_quat(model.eq_data[i, 6:10], scalar_first=True).as_matrix()
        if compiled.group(bodies[0]) != compiled.group(bodies[1]):
            turned = [Rotation.from_matrix(frames[0] @ frames[1].T).as_rotvec()] if is_weld else []
            closed.append(Loop(i, bodies, points, np.array([points[0] - points[1], *turned])))
    return closed


def close(compiled: Compiled) -> None:
    """Move joints so that small gaps close, in place; refuse wide gaps."""
    model, mujoco, data = compiled.model, compiled.mujoco, compiled.data
    _refuse_gaps(compiled, WIDEST_GAP, "is open at the start by")
    for _ in range(ITERATIONS):
        closing = loops(compiled)
        if max((_size(compiled, loop) for loop in closing), default=0.0) <= ROUND_OFF_GAP:
            return
        jacobian = np.concatenate([_jacobian(compiled, loop) for loop in closing])
        gaps = np.concatenate([loop.gap.ravel() for loop in closing])
        mujoco.mj_integratePos(model, data.qpos, np.linalg.lstsq(jacobian, -gaps, rcond=RANK)[0], 1.0)
        mujoco.mj_forward(model, data)
    _refuse_gaps(compiled, WIDEST_LEFT, "does not close; its remaining gap is")


def _refuse_gaps(compiled: Compiled, widest: float, phrase: str) -> None:
    """Raise ValueError if a loop has a gap above `widest`; the message says "{name} {phrase} {gap}"."""
    gaps = []
    for loop in loops(compiled):
        if _size(compiled, loop) > widest:
            sizes = zip(np.linalg.norm(loop.gap, axis=1), ("m", "rad"), strict=False)
            gap = " and ".join(f"{size:.3g} {unit}" for size, unit in sizes)
            gaps.append(f"{compiled.name('equality', loop.number)} {phrase} {gap}")
    if gaps:
        raise Refused(f"Scene.from_mujoco: {'; '.join(gaps)}. {ADVICE}")


def _size(compiled: Compiled, loop: Loop) -> float:
    """The gap of a loop, in extents of the model or rad."""
    return float(np.max(np.linalg.norm(loop.gap, axis=1) / [compiled.extent, 1.0][: len(loop.gap)]))


def _jacobian(compiled: Compiled, loop: Loop) -> np.ndarray:
    """The Jacobian of the gap with respect to MuJoCo's velocities, (3, nv), of a weld (6, nv)."""
    sides = np.zeros((2, 2, 3, compiled.model.nv))
    for (of_point, of_rotation), body, point in zip(sides, loop.bodies, loop.points, strict=True):
        compiled.mujoco.mj_jac(compiled.model, compiled.data, of_point, of_rotation, point, body)
    return (sides[0] - sides[1])[: len(loop.gap)].reshape(-1, compiled.model.nv)


def polynomial(x, params):
    """``y - sum_k a_k z^k``, where y and z are sums ``r . x + c`` of the joint coordinates x."""
    y, z = params["ratios"] @ x + params["offsets"]
    return y - jnp.polyval(params["coefficients"][::-1], z)


def couplings(compiled: Compiled) -> Iterator[JointCoupling]:
    """The couplings that the model does not switch off, none of which the start may violate."""
    model = compiled.model
    for i in filter(compiled.ties, compiled.equalities):
        sides = [_ratios(compiled, i, int(number)) for number in (model.eq_obj1id[i], model.eq_obj2id[i])]
        joints = sorted({j for side in sides for j in side})
        ratios = np.array([[side.get(j, 0.0) for j in joints] for side in sides])
        places = model.jnt_qposadr[joints]
        coefficients = np.where(np.any(ratios[1]), model.eq_data[i, :5], [model.eq_data[i, 0], 0, 0, 0, 0])
        offsets = ratios @ (
            compiled.data.qpos[places] - model.qpos0[places]
        )  # a scene counts coordinates from the start
        params = {"ratios": ratios, "offsets": offsets, "coefficients": coefficients}
        name = compiled.name("equality", i)
        violation = abs(float(polynomial(jnp.zeros(len(joints)), params)))
        if violation > WIDEST_GAP:
            raise Refused(f"Scene.from_mujoco: {name} is violated by {violation:.3g} at the start. {ADVICE}")
        yield JointCoupling([compiled.name("joint", j) for j in joints], polynomial, params, name=name)


def _ratios(compiled: Compiled, i: int, number: int) -> dict[int, float]:
    """The ratios of the joints on a side of equality i, by number of the joint; {} if `number` is negative."""
    model = compiled.model
    if number < 0:
        return {}
    if model.eq_type[i] == compiled.mujoco.mjtEq.mjEQ_JOINT:
        return {number: 1.0}
    wraps = model.tendon_adr[number] + np.arange(model.tendon_num[number])
    return {int(model.wrap_objid[w]): float(model.wrap_prm[w]) for w in wraps}

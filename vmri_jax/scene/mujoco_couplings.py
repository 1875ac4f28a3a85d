"""The equalities of a model of MuJoCo that tie joints, or fixed tendons: one is a polynomial of the other,

    y - y_0 = a_0 + a_1 (x - x_0) + ... + a_4 (x - x_0)^4,

where y and x are each a coordinate of a joint, or the length of a fixed tendon, a sum of such coordinates in constant ratios; y_0 and
x_0 are theirs at qpos0. Without a second one y is held at ``y_0 + a_0``.

Source: MuJoCo's documentation, "XML reference", equality/joint and equality/tendon.
"""

from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np

from vmri_jax.scene.effects.couplings import JointCoupling
from vmri_jax.scene.mujoco_loops import WIDEST
from vmri_jax.scene.mujoco_model import Compiled


def polynomial(x, params):
    """``y - sum_k a_k z^k``, with y and z the sums ``r . x + c`` of coordinates x."""
    y, z = params["ratios"] @ x + params["offsets"]
    return y - jnp.polyval(params["coefficients"][::-1], z)


def couplings(compiled: Compiled, data: Any) -> Iterator[JointCoupling]:
    """Those that act.

    Args:
        compiled: the model.
        data: `mujoco.MjData` at the start.

    Raises:
        ValueError: one that the start does not keep.
    """
    model = compiled.model
    for i in compiled.equalities:
        if not compiled.ties(i):
            continue
        sides = [_ratios(compiled, i, int(number)) for number in (model.eq_obj1id[i], model.eq_obj2id[i])]
        joints = sorted({j for side in sides for j in side})
        ratios = np.array([[side.get(j, 0.0) for j in joints] for side in sides])
        places = model.jnt_qposadr[joints]
        coefficients = np.where(np.any(ratios[1]), model.eq_data[i, :5], [model.eq_data[i, 0], 0, 0, 0, 0])
        params = {
            "ratios": ratios,
            "offsets": ratios @ (data.qpos[places] - model.qpos0[places]),  # a scene counts coordinates from the start
            "coefficients": coefficients,
        }
        name = compiled.name("equality", i)
        apart = abs(float(polynomial(jnp.zeros(len(joints)), params)))
        if apart > WIDEST:
            raise ValueError(
                f"Scene.from_mujoco: {name} is missed by {apart:.3g} at the start. Here equalities hold exactly: give a qpos where it is "
                "kept, as one at which MuJoCo's simulation comes to rest, or switch it off in the model."
            )
        yield JointCoupling([compiled.name("joint", j) for j in joints], polynomial, params, name=name)


def _ratios(compiled: Compiled, i: int, number: int) -> dict[int, float]:
    """The ratios of one side of an equality by the joints in it; none where the side is not there."""
    model = compiled.model
    if number < 0:
        return {}
    if model.eq_type[i] == compiled.mujoco.mjtEq.mjEQ_JOINT:
        return {number: 1.0}
    wraps = model.tendon_adr[number] + np.arange(model.tendon_num[number])
    return {int(model.wrap_objid[w]): float(model.wrap_prm[w]) for w in wraps}

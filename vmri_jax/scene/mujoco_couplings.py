"""The equalities of a model of MuJoCo that couple two joints, or two fixed tendons, by a polynomial,

    y - y_0 = a_0 + a_1 (x - x_0) + ... + a_4 (x - x_0)^4.

y and x are the coordinates of the joints, or the lengths of the tendons: sums of joint coordinates with constant ratios. y_0 and
x_0 are their values at qpos0. Without a second joint or tendon the equality is ``y = y_0 + a_0``.

Source: MuJoCo's documentation, "XML reference", equality/joint and equality/tendon.
"""

from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np

from vmri_jax.scene.effects.couplings import JointCoupling
from vmri_jax.scene.mujoco_loops import WIDEST_GAP
from vmri_jax.scene.mujoco_model import Compiled


def polynomial(x, params):
    """``y - sum_k a_k z^k``, where y and z are sums ``r . x + c`` of the joint coordinates x."""
    y, z = params["ratios"] @ x + params["offsets"]
    return y - jnp.polyval(params["coefficients"][::-1], z)


def couplings(compiled: Compiled, data: Any) -> Iterator[JointCoupling]:
    """The couplings that the model does not switch off, none of which the start may violate."""
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
        violation = abs(float(polynomial(jnp.zeros(len(joints)), params)))
        if violation > WIDEST_GAP:
            raise ValueError(
                f"Scene.from_mujoco: {name} is violated by {violation:.3g} at the start. Here equalities hold exactly: give a qpos where "
                "it holds, as one at which MuJoCo's simulation comes to rest, or switch the equality off in the model."
            )
        yield JointCoupling([compiled.name("joint", j) for j in joints], polynomial, params, name=name)


def _ratios(compiled: Compiled, i: int, number: int) -> dict[int, float]:
    """The ratios of the joints on a side of an equality, by number of the joint; {} for an equality without this side.

    Args:
        i: number of the equality.
        number: of the joint or tendon on this side; negative if there is none.
    """
    model = compiled.model
    if number < 0:
        return {}
    if model.eq_type[i] == compiled.mujoco.mjtEq.mjEQ_JOINT:
        return {number: 1.0}
    wraps = model.tendon_adr[number] + np.arange(model.tendon_num[number])
    return {int(model.wrap_objid[w]): float(model.wrap_prm[w]) for w in wraps}

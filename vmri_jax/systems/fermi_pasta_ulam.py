"""The Fermi-Pasta-Ulam chain: stiff linear springs alternating with soft quartic ones.

Slow variables are the (scaled) centres of the stiff springs, fast ones their (scaled) elongations:
Hairer, Lubich, Wanner, *Geometric Numerical Integration*, I.5.1.
"""

import math
from itertools import pairwise
from typing import Any

import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import library
from vmri_jax.mechanics.names import Names
from vmri_jax.mechanics.state import Problem
from vmri_jax.mechanics.system import ConstantMass, System
from vmri_jax.refusals import Refused

MAGNIFICATION = 10.0
"""Drawn over real elongation of the stiff springs, which stretch by a few percent: with 1 they seem rigid."""


def soft_springs(q_s, q_f, params):
    """``V = 1/4 [(s_1 - f_1)^4 + sum_i (s_{i+1} - f_{i+1} - s_i - f_i)^4 + (s_l + f_l)^4]``."""
    wall = jnp.zeros(1)
    left, right = jnp.concatenate([wall, q_s + q_f]), jnp.concatenate([q_s - q_f, wall])
    return jnp.sum((right - left) ** 4) / 4


def stiff_springs(q_f, params):
    """``W = omega^2 / 2 |f|^2``."""
    return params["omega"] ** 2 / 2 * jnp.sum(q_f**2)


def drawing(num_springs: int) -> dict[str, Any]:
    """The chain between two walls: masses displaced by ``(s_i - f_i) / sqrt 2`` and ``(s_i + f_i) / sqrt 2``."""
    bodies, w, look = [], 1 / math.sqrt(2), {"radius": 0.3, "color": "#8a97a1"}
    for i in range(num_springs):
        for sign, place in ((-1.0, 4.5 * i + 3.0), (1.0, 4.5 * i + 4.5)):
            form = [[w, "s", i], [sign * MAGNIFICATION * w, "f", i]]
            bodies.append({"name": f"mass {len(bodies) + 1}", "coordinates": [form], "offset": [place], **look})
    names = [body["name"] for body in bodies]
    walls = [(names[0], 0.0), (names[-1], 4.5 * num_springs + 3.0)]
    return {
        "bodies": bodies,
        "springs": [[a, b, "slow" if i % 2 else "fast"] for i, (a, b) in enumerate(pairwise(names))],
        "anchors": [{"body": name, "point": [x], "kind": "spring", "pace": "slow"} for name, x in walls],
        "planes": [{"point": [x], "normal": [normal]} for (_, x), normal in zip(walls, (1.0, -1.0), strict=True)],
        "caption": f"Elongations of the stiff springs are drawn {MAGNIFICATION:g} times as large as they are.",
    }


def fermi_pasta_ulam(num_springs: int = 3, omega: float = 50.0) -> Problem:
    """FPU chain of `num_springs` stiff springs of frequency `omega`, unit masses, started as in HLW.

    ``s_1 = 1, f_1 = 1 / omega``, unit velocities in both, all else at rest.

    Args:
        num_springs: l, number of stiff springs = slow variables = fast variables.
        omega: frequency of the stiff springs.
    """
    if num_springs < 1:
        raise Refused(f"fermi_pasta_ulam: num_springs is {num_springs}; there must be at least 1.")
    ones, first = np.ones(num_springs), np.eye(num_springs)[0]
    system = System(
        ConstantMass(ones, ones), soft_springs, stiff_springs, params={"omega": library(omega).asarray(omega)}
    )
    names = Names({"centres": num_springs}, {"elongations": num_springs}, numbered=("centres", "elongations"))
    return Problem(system, first, first / omega, first, first, names=names, drawing=drawing(num_springs))

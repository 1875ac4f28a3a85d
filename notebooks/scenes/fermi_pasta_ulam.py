"""The Fermi-Pasta-Ulam chain: stiff linear springs, which exchange energy slowly, alternate with soft quartic ones.

Teaches: blocks of general coordinates with custom potentials, here the (scaled) centres and elongations of the
stiff springs: Hairer, Lubich, Wanner, *Geometric Numerical Integration*, I.5.1.

    vmri simulate notebooks/scenes/fermi_pasta_ulam.py:scene --scheme fully-explicit --num-micro 5 --macro-dt 0.01 --steps 10000 --save-micro --out fermi_pasta_ulam.npz
    vmri animate fermi_pasta_ulam.npz --out fermi_pasta_ulam.png --frames 3
"""

import jax.numpy as jnp
import numpy as np

from vmri_jax.scene import Body, Potential, Scene

NUM_SPRINGS, OMEGA = 3, 50.0  # rad/s


def soft_springs(q, params):
    """``V = 1/4 sum (s_{i+1} - f_{i+1} - s_i - f_i)^4``, between walls."""
    s, f = q
    wall = jnp.zeros(1)
    left, right = jnp.concatenate([wall, s + f]), jnp.concatenate([s - f, wall])
    return jnp.sum((right - left) ** 4) / 4


def stiff_springs(q, params):
    """``W = omega^2 / 2 |f|^2``."""
    (f,) = q
    return params["omega"] ** 2 / 2 * jnp.sum(f**2)


first = np.eye(NUM_SPRINGS)[0]  # the first spring starts, the others are at rest
scene = Scene(
    [
        Body("centres", 1.0, first, first, pace="slow", block=True),
        Body("elongations", 1.0, first / OMEGA, first, pace="fast", block=True),
    ],
    [
        Potential(soft_springs, ("centres", "elongations")),
        Potential(stiff_springs, "elongations", {"omega": OMEGA}),
    ],
)

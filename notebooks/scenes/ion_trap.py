"""Ions in a Penning trap: light ones gyrate fast, heavy ones drift slowly; all repel each other.

Teaches: a velocity-dependent Lagrangian; the canonical angular momentum about the field is kept to round-off.

    vmri simulate notebooks/scenes/ion_trap.py:scene --num-micro 10 --macro-dt 0.05 --steps 1000 --save-micro --out ion_trap.npz
    vmri animate ion_trap.npz --out ion_trap.png --frames 3
"""

import jax.numpy as jnp

from vmri_jax.scene import Body, Coulomb, MagneticField, Potential, Scene

CHARGE = 1.0
FIELD = 20.0  # along z; the light ions gyrate at Q B / m = 20 rad/s, the heavy ones at 1 rad/s


def quadrupole(q, params):
    """``V = k/2 sum (z^2 - (x^2 + y^2) / 2)``: holds ions along z and drives them out across it, where the field holds."""
    positions = jnp.stack(q)
    return params["stiffness"] / 4 * jnp.sum(3 * positions[:, 2] ** 2 - jnp.sum(positions**2, axis=1))


ions = [  # who is slow and who is fast follows from these frequencies
    Body("heavy 1", 20.0, [1.2, 0.0, 0.6], [0.0, -0.3, 0.0], radius=0.12),
    Body("heavy 2", 20.0, [-1.2, 0.0, -0.6], [0.0, 0.3, 0.2], radius=0.12),
    Body("light 1", 1.0, [0.5, 0.8, 0.4], [4.0, 0.0, 0.5], radius=0.06),
    Body("light 2", 1.0, [-0.5, -0.8, -0.8], [0.0, 4.0, 0.0], radius=0.06),
]
names = [ion.name for ion in ions]

scene = Scene(
    ions,
    [
        MagneticField([0.0, 0.0, FIELD], CHARGE),
        Potential(quadrupole, names, {"stiffness": 4.0}),
        Coulomb(dict.fromkeys(names, CHARGE), constant=1.0),
    ],
)

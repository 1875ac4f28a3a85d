"""An elastic chain of ten balls falls on the ground and bounces: flight is slow, links and contact are fast.

Teaches: contact as a smooth penalty belongs to the fast potential, where micro steps resolve it.

    vmri simulate notebooks/scenes/bouncing_chain.py:scene --scheme fully-explicit --num-micro 5 --macro-dt 0.004 --steps 1500 --save-micro --out bouncing_chain.npz
    vmri animate bouncing_chain.npz --out bouncing_chain.png --frames 3
"""

from itertools import pairwise

import numpy as np

from vmri_jax.scene import Bending, Body, Gravity, PlaneContact, Scene, Spring

COUNT, LENGTH, MASS, RADIUS, TILT = 10, 0.3, 0.1, 0.1, 0.35

direction = np.array([np.cos(TILT), 0.0, np.sin(TILT)])
names = [f"ball {i + 1}" for i in range(COUNT)]

scene = Scene(
    [
        Body(name, MASS, i * LENGTH * direction + [0.0, 0.05 * np.sin(i), 1.0], [0.5, 0.0, 0.0], pace="fast")
        for i, name in enumerate(names)
    ],
    [
        Gravity(9.81, rate="slow"),
        Spring(list(pairwise(names)), 1000.0),
        Bending(list(zip(names, names[1:], names[2:], strict=False)), 1.0),
        PlaneContact(
            point=[0.0, 0.0, 0.0],
            normal=[0.0, 0.0, 1.0],
            stiffness=1000.0,
            smoothing=0.01,
            radius=RADIUS,
            name="ground",
        ),
    ],
)

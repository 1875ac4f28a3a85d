"""A heavy top that precesses and nods: a disc on a ball joint.

Teaches: a rigid body by its directors; the ground as a body; a joint as an effect; a body that spins is fast.

    vmri simulate notebooks/scenes/spinning_top.py:scene --scheme fully-implicit --num-micro 5 --macro-dt 0.0125 --steps 320 --save-micro --out spinning_top.npz
    vmri animate spinning_top.npz --out spinning_top.png --frames 3 --to 3
"""

import numpy as np

from vmri_jax.scene import Cylinder, Gravity, RigidBody, Scene, Spherical

LENGTH, TILT, SPIN = 0.4, 0.5, 70.0  # m from the tip to the centre of the disc, rad from upright, rad/s about its axis

axis = np.array([np.sin(TILT), 0.0, np.cos(TILT)])

scene = Scene(
    [
        RigidBody(
            "disc",
            0.5,
            Cylinder(radius=0.2, length=0.05),
            LENGTH * axis,
            rotation=[0.0, TILT, 0.0],
            spin=SPIN * axis,
            pace="fast",
        )
    ],
    [Gravity(), Spherical(("ground", "disc"), at=[0.0, 0.0, 0.0], name="tip")],
)

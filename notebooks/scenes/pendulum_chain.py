"""A hanging chain of fifty stiff springs that swings: slow as a whole, fast along its links.

Teaches: an explicit scheme solves nothing, however long the chain; gravity is evaluated once per macro step.

    vmri simulate notebooks/scenes/pendulum_chain.py:scene --scheme fully-explicit --num-micro 10 --macro-dt 0.02 --steps 1000 --save-micro --out pendulum_chain.npz
    vmri animate pendulum_chain.npz --out pendulum_chain.png --frames 3
"""

from itertools import pairwise

import numpy as np

from vmri_jax.scene import Body, Gravity, Scene, Spring, SpringAnchor

LINKS, LENGTH, MASS, STIFFNESS = 50, 0.2, 0.1, 2000.0
G, ANGLE = 9.81, 0.8  # m/s^2; rad from the vertical at the start

direction = np.array([np.sin(ANGLE), -np.cos(ANGLE)])
below = MASS * np.arange(LINKS, 0, -1)  # mass that hangs on each link
lengths = LENGTH + G * below * np.cos(ANGLE) / STIFFNESS  # stretched by it
names = [f"m{i}" for i in range(LINKS)]

scene = Scene(
    [
        Body(name, MASS, distance * direction, pace="fast")
        for name, distance in zip(names, np.cumsum(lengths), strict=True)
    ],
    [
        Gravity(G, rate="slow"),
        SpringAnchor(names[0], [0.0, 0.0], STIFFNESS, LENGTH, name="hook", rate="fast"),
        Spring(list(pairwise(names)), STIFFNESS, LENGTH, rate="fast"),
    ],
)

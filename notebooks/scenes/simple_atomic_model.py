"""Six atoms that hang from a point: two heavy ones (slow), below them a tetrahedron and one more of light ones (fast).

Teaches: the pace of a body may be given; soft springs and gravity are slow although they touch fast bodies.

    vmri simulate notebooks/scenes/simple_atomic_model.py:scene --num-micro 10 --macro-dt 0.02 --steps 2500 --save-micro --out simple_atomic_model.npz
    vmri animate simple_atomic_model.npz --out simple_atomic_model.png --frames 3
"""

import numpy as np

from vmri_jax.scene import Anchor, Body, Gravity, RigidLink, Scene, Spring

LENGTH = 10.0  # of all bonds, and of all springs at rest
radius, inradius, height = LENGTH * np.sqrt(np.array([1 / 3, 1 / 12, 2 / 3]))  # of a regular tetrahedron
top = -2 * LENGTH - height  # of the face 3-4-5 below atom 2

heavy = [
    Body("1", 100.0, [0.0, 0.0, -LENGTH], [0.0, 0.5, 0.0], pace="slow", radius=2.6),
    Body("2", 40.0, [0.0, 0.0, -2 * LENGTH], [0.3, 0.2, 0.1], pace="slow", radius=2.0),
]
light = [
    ("3", [radius, 0.0, top], [0.0, 0.4, 0.2]),
    ("4", [-inradius, LENGTH / 2, top], [-0.5, 0.2, 0.3]),
    ("5", [-inradius, -LENGTH / 2, top], [0.2, -0.6, 0.4]),
    ("6", [radius, 0.0, top - LENGTH], [0.7, 0.1, 0.2]),
]

scene = Scene(
    [*heavy, *(Body(name, 1.0, place, kick, pace="fast", radius=1.3) for name, place, kick in light)],
    [
        Spring(("1", "2"), 10.0, LENGTH, name="soft 1-2"),
        Spring(("2", "3"), 1.0, LENGTH, name="soft 2-3"),
        Gravity(9.81),
        Spring([("3", "4"), ("4", "5"), ("5", "3")], 4000.0, LENGTH, name="stiff"),
        RigidLink([("2", "4"), ("2", "5"), ("3", "6")], LENGTH),
        Anchor("1", [0.0, 0.0, 0.0], LENGTH),
    ],
    project=True,  # velocities onto the bonds
)

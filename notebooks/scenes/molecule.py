"""A chain of five atoms among three heavy ones: bonds and angles are fast, torsion and Lennard-Jones forces slow.

Teaches: the scene sorts effects by stiffness itself; ask `vmri explain notebooks/scenes/molecule.py:scene`.

    vmri simulate notebooks/scenes/molecule.py:scene --scheme fully-explicit --num-micro 8 --macro-dt 0.005 --steps 4000 --save-micro --out molecule.npz
    vmri animate molecule.npz --out molecule.png --frames 3 --to 6
"""

import numpy as np

from vmri_jax.scene import Angle, Body, LennardJones, Scene, Spring, Torsion

BOND, ANGLE = 0.45, np.radians(111)  # units of Lennard-Jones: diameter, depth and mass of an atom are 1
step = BOND * np.array([np.sin(ANGLE / 2), np.cos(ANGLE / 2)])

chain = ["C1", "C2", "C3", "C4", "C5"]
places = np.array([[i * step[0], (-1) ** i * step[1] / 2, 0.0] for i in range(-2, 3)])
places[4, 2] += 0.25  # bonds, angles and torsion all start strained
kicks = np.array([[0.0, 0.5, 0.3], [0.4, 0.0, -0.6], [0.0, -0.8, 0.5], [-0.4, 0.0, -0.6], [0.0, 0.3, 0.4]])
heavy = {"A1": [0.1, 1.35, 0.2], "A2": [-0.2, -0.7, 1.15], "A3": [0.3, -0.8, -1.1]}

scene = Scene(
    [
        *(Body(name, 1.0, place, kick, radius=0.15) for name, place, kick in zip(chain, places, kicks, strict=True)),
        *(Body(name, 10.0, place, radius=0.3) for name, place in heavy.items()),
    ],
    [
        Spring([("C1", "C2"), ("C2", "C3"), ("C3", "C4"), ("C4", "C5")], 5000.0, BOND, name="bonds"),
        Angle([("C1", "C2", "C3"), ("C2", "C3", "C4"), ("C3", "C4", "C5")], 200.0, ANGLE),
        Torsion([("C1", "C2", "C3", "C4"), ("C2", "C3", "C4", "C5")], 2.0, angle=np.pi, multiplicity=3),
        LennardJones(
            1.0,
            1.0,
            [(a, c) for a in heavy for c in chain] + [("A1", "A2"), ("A2", "A3"), ("A3", "A1"), ("C1", "C5")],
        ),
    ],
)

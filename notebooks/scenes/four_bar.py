"""A chain of closed loops: cranks on hinges, joined by rods; the N-loop four-bar linkage, a benchmark of IFToMM.

Teaches: in closed loops of hinges in a plane some constraints follow from the others; the scene leaves them out and names them.

Source: F. Gonzalez, A. Luaces, U. Lugris, M. Gonzalez, Non-intrusive parallelization of multibody system dynamic simulations,
Comput. Mech. 44 (2009), case A02 of the IFToMM library of benchmarks.

    vmri simulate notebooks/scenes/four_bar.py:scene --scheme fully-implicit --num-micro 1 --macro-dt 0.01 --steps 1000 --out four_bar.npz
    vmri animate four_bar.npz --out four_bar.png --frames 3 --to 3 --view=-80,12
"""

import numpy as np

from vmri_jax.scene import Cylinder, Gravity, Revolute, RigidBody, Scene

UP, ACROSS = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])


def linkage(loops: int, speed: float = 1.0) -> Scene:
    """So many loops side by side; all bars are 1 m long and of 1 kg, and the upper ones move along x with this speed, m/s."""
    bar, spin = Cylinder(radius=0.03, length=1.0), speed * ACROSS
    feet = [np.array([i, 0.0, 0.0]) for i in range(loops + 1)]
    cranks = [
        RigidBody(f"crank {i}", 1.0, bar, foot + UP / 2, velocity=np.cross(spin, UP / 2), spin=spin)
        for i, foot in enumerate(feet)
    ]
    rods = [
        RigidBody(f"rod {i}", 1.0, bar, foot + UP + [0.5, 0.0, 0.0], [0.0, np.pi / 2, 0.0], velocity=[speed, 0.0, 0.0])
        for i, foot in enumerate(feet[:-1])
    ]
    pins = [(f"crank {i + k}", f"rod {i}") for i in range(loops) for k in (0, 1)]
    return Scene(
        [*cranks, *rods],
        [
            Gravity(),
            Revolute([("ground", crank.name) for crank in cranks], feet, ACROSS, name="feet"),
            Revolute(pins, [foot + UP for i in range(loops) for foot in feet[i : i + 2]], ACROSS, name="pins"),
        ],
        redundant="drop",
    )


scene = linkage(2)

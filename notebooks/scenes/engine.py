"""An engine with a valve: crank, rod and piston turn slowly by a given motion, the valve on its stiff spring follows a cam fast.

Teaches: a slow mechanism that drives a fast part; a body whose motion is given; a cam as a potential of your own; springs with mass.

    vmri simulate notebooks/scenes/engine.py:scene --scheme explicit-slow --num-micro 10 --macro-dt 0.00025 --steps 800 --save-micro --out engine.npz
    vmri animate engine.npz --out engine.png --frames 3 --to 0.04 --view=-70,15
"""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.scene import (
    Body,
    Box,
    Cylinder,
    JointMotion,
    LinearDamping,
    Potential,
    Prismatic,
    Revolute,
    RigidBody,
    Scene,
    Spring,
)

CRANK, ROD, START, SPEED = 0.05, 0.18, 1.0, 100.0  # m, m, rad from the top, rad/s: 955 turns in a minute
LENGTH, CONTACT = (
    0.006,
    3.0e5,
)  # m, of a piece of the valve spring at rest; N/m, of the valve on its seat and on the cam
SIDE, UP = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
VALVE = np.array([0.12, 0.0, 0.1])
"""Where the valve is closed, beside the cylinder."""


def steady(t, params):
    """The crank turns at one speed."""
    return params["speed"] * t


def cam(q, params):
    """Contact of the valve with its seat, which a lobe lifts that turns with the crank: ``k/2 d^2``, d the depth of contact."""
    crank, valve = q
    along, up = crank[11], crank[9]  # the third director is at (sin, 0, cos) of the angle of the crank
    lobe = params["lift"] * jnp.exp(params["sharpness"] * (along * params["cos"] + up * params["sin"] - 1))
    depth = params["smoothing"] * jax.nn.softplus((lobe - (valve[2] - params["seat"])) / params["smoothing"])
    return params["stiffness"] / 2 * depth**2


pin = CRANK * np.array([np.sin(START), 0.0, np.cos(START)])
lean = -np.arcsin(pin[0] / ROD)
wrist = pin + ROD * np.array([np.sin(lean), 0.0, np.cos(lean)])

crank = RigidBody("crank", 2.0, Box((0.04, 0.03, 0.14)), [0.0, 0.0, 0.0], START * SIDE, pace="slow")
rod = RigidBody("rod", 0.4, Box((0.02, 0.02, ROD)), (pin + wrist) / 2, lean * SIDE, pace="slow")
piston = RigidBody("piston", 0.5, Cylinder(radius=0.045, length=0.06), wrist, pace="slow")
valve = RigidBody("valve", 0.08, Cylinder(radius=0.02, length=0.06), VALVE, pace="fast")
coils = [Body(f"coil {k}", 0.01, VALVE - (0.03 + 0.012 * k) * UP, pace="fast", radius=0.004) for k in range(1, 5)]
foot = VALVE - 0.09 * UP
chain = [("valve", [0.0, 0.0, -0.03]), *(coil.name for coil in coils), ("ground", foot)]

scene = Scene(
    [crank, rod, piston, valve, *coils],
    [
        Revolute(("ground", "crank"), [0.0, 0.0, 0.0], SIDE, name="shaft"),
        Revolute([("crank", "rod"), ("rod", "piston")], [pin, wrist], SIDE, name="pins"),
        Prismatic(("ground", "piston"), wrist, UP, name="cylinder"),
        JointMotion("shaft", steady, {"speed": SPEED}),
        Prismatic(("ground", "valve"), VALVE, UP, name="guide"),
        Spring(list(pairwise(chain)), 1.0e5, LENGTH, name="valve spring", rate="fast"),
        LinearDamping(4.0, "valve"),
        Potential(
            cam,
            ("crank", "valve"),
            {
                "lift": 0.01,
                "sharpness": 4.0,
                "cos": np.cos(3.0),
                "sin": np.sin(3.0),
                "seat": VALVE[2] + 1.0e5 * (0.012 - LENGTH) / CONTACT,  # at rest the spring presses it onto the seat
                "smoothing": 2e-4,
                "stiffness": CONTACT,
            },
        ),
    ],
    redundant="drop",
    project=True,
)

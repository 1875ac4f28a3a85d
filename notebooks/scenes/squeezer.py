"""Andrews' squeezer: seven bodies in three loops, driven by a motor; the standard test of solvers of mechanisms.

Teaches: a mechanism from its published data; a scene without a fast part.

Source: E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, VII.7, after W. Schiehlen, Multibody Systems Handbook,
1990. In the plane z = 0; units are those of the source, m, kg, s.

    vmri simulate notebooks/scenes/squeezer.py:scene --scheme galerkin --degree 2 --num-micro 1 --macro-dt 0.0001 --steps 300 --out squeezer.npz
    vmri animate squeezer.npz --out squeezer.png --frames 3 --view=-90,89
"""

import jax.numpy as jnp
import numpy as np

from vmri_jax.scene import JointDrive, Revolute, RigidBody, Scene, Spring

MASSES = [0.04325, 0.00365, 0.02373, 0.00706, 0.07050, 0.00706, 0.05498]
MOMENTS = [2.194e-6, 4.410e-7, 5.255e-6, 5.667e-7, 1.169e-5, 5.667e-7, 1.912e-5]
A, B, C = np.array([-0.06934, -0.00227]), np.array([-0.03635, 0.03273]), np.array([0.014, 0.072])
D, DA, E, EA, RR, RA, SS, SA, SB, SC, SD = (
    0.028,
    0.0115,
    0.02,
    0.01421,
    0.007,
    0.00092,
    0.035,
    0.01874,
    0.01043,
    0.018,
    0.02,
)
TA, TB, U, UA, UB, ZF, ZT, FA = 0.02308, 0.00916, 0.04, 0.01228, 0.00449, 0.02, 0.04, 0.01421
STIFFNESS, LENGTH, TORQUE = 4530.0, 0.07785, 0.033
START = {
    "beta": -0.0617138900142764496358948458001,
    "theta": 0.0,
    "gamma": 0.455279819163070380255912382449,
    "phi": 0.222668390165885884674473185609,
    "delta": 0.487364979543842550225598953530,
    "omega": -0.222668390165885884674473185609,
    "epsilon": 1.23054744454982119249735015568,
}
"""Angles of the source, rad, that fulfil the constraints."""


def turned(angle, x, y):
    """A vector of a bar at this angle, in the plane."""
    return np.array([x * np.cos(angle) - y * np.sin(angle), x * np.sin(angle) + y * np.cos(angle)])


def motor(t, params):
    """A constant torque."""
    return params["torque"] * jnp.ones_like(t)


beta, theta, gamma, phi, delta, omega, epsilon = START.values()
angles = [beta, beta + theta, gamma, phi + delta, delta, omega + epsilon, epsilon]
tip = turned(beta, RR, 0) - turned(beta + theta, D, 0)
"""Where three bars meet."""
centres = [
    turned(beta, RA, 0),
    turned(beta, RR, 0) - turned(beta + theta, DA, 0),
    B + turned(gamma, SB, -SA),
    A + turned(delta, ZT, 0) + turned(phi + delta, 0, EA - E),
    A + turned(delta, TA, TB),
    A + turned(epsilon, 0, -U) + turned(omega + epsilon, ZF - FA, 0),
    A + turned(epsilon, -UB, -UA),
]
bars = [
    RigidBody(f"K{k + 1}", mass, [moment] * 3, [*centre, 0.0], [0.0, 0.0, angle], pace="slow")
    for k, (mass, moment, centre, angle) in enumerate(zip(MASSES, MOMENTS, centres, angles, strict=True))
]
JOINTS = {
    ("ground", "K1"): [0.0, 0.0],
    ("K1", "K2"): turned(beta, RR, 0),
    ("ground", "K3"): B,
    ("ground", "K5"): A,
    ("ground", "K7"): A,
    ("K5", "K4"): A + turned(delta, ZT, 0),
    ("K7", "K6"): A + turned(epsilon, 0, -U),
    ("K2", "K3"): tip,
    ("K2", "K4"): tip,
    ("K2", "K6"): tip,
}
hinges = Revolute(list(JOINTS)[1:], [[*point, 0.0] for point in list(JOINTS.values())[1:]], name="hinges")

scene = Scene(
    bars,
    [
        Revolute(("ground", "K1"), [0.0, 0.0, 0.0], name="motor shaft"),
        hinges,
        JointDrive("motor shaft", motor, {"torque": TORQUE}),
        Spring((("K3", [SD - SB, SA - SC, 0.0]), ("ground", [*C, 0.0])), STIFFNESS, LENGTH),
    ],
    redundant="drop",
    project=True,
)

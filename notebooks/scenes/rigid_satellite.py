"""A satellite turned by its momentum wheels: a rigid hub, slow, and booms of hinged panels that vibrate fast.

Teaches: joints between slow and fast rigid bodies; springs and drives in hinges; joint coordinates, six angles instead of six panels.

    vmri simulate notebooks/scenes/rigid_satellite.py:scene --scheme fully-explicit --num-micro 10 --macro-dt 0.02 --steps 600 --save-micro --out rigid_satellite.npz
    vmri animate rigid_satellite.npz --out rigid_satellite.png --frames 3 --to 12 --view=-60,25
"""

import jax.numpy as jnp
import numpy as np

from vmri_jax.scene import Box, Cylinder, JointDrive, JointSpring, Revolute, RigidBody, Scene

HUB, PANEL, WIDTH, THICK = 1.0, 0.8, 0.6, 0.03  # m, edges of the hub and of the panels
TORQUE, TURNED = 6.0, 6.0  # N m, s: wheels speed up for half of that time, and slow down for the other half


def start_and_stop(t, params):
    """One way, then back, switched within a tenth of a second."""
    steps = [jnp.tanh((t - when) / 0.05) for when in (0.0, params["time"] / 2, params["time"])]
    return params["torque"] * (steps[0] - 2 * steps[1] + steps[2]) / 2


def boom(name, side, panels=3):
    """Panels along y on one side of the hub, each hinged to the one before about x."""
    bodies, pairs, points = [], [], []
    before = "hub"
    for k in range(panels):
        root = side * (HUB / 2 + k * PANEL)
        panel = f"{name} {k + 1}"
        bodies.append(
            RigidBody(panel, 2.0, Box((WIDTH, PANEL, THICK)), [0.0, root + side * PANEL / 2, 0.0], pace="fast")
        )
        pairs.append((before, panel))
        points.append([0.0, root, 0.0])
        before = panel
    return bodies, Revolute(pairs, points, axis=[1.0, 0.0, 0.0], name=f"{name} hinges")


left, left_hinges = boom("left", -1.0)
right, right_hinges = boom("right", 1.0)
axle = [HUB / 2 + 0.06, 0.0, 0.0]
wheel = RigidBody("wheel", 20.0, Cylinder(radius=0.35, length=0.1), axle, [0.0, np.pi / 2, 0.0], pace="slow")

scene = Scene(
    [RigidBody("hub", 100.0, Box((HUB, HUB, HUB)), [0.0, 0.0, 0.0], pace="slow"), wheel, *left, *right],
    [
        Revolute(("hub", "wheel"), axle, axis=[1.0, 0.0, 0.0], name="bearing"),
        JointDrive("bearing", start_and_stop, {"torque": TORQUE, "time": TURNED}),
        left_hinges,
        right_hinges,
        JointSpring("left hinges", 150.0, name="left springs"),
        JointSpring("right hinges", 150.0, name="right springs"),
    ],
    coordinates="joint",
)

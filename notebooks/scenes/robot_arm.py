"""A robot arm on a pillar: joints turned by motors, a hand on a springy wrist, in joint coordinates.

Teaches: in joint coordinates an arm is four angles, instead of 48 numbers and 44 rows; motors in joints; a stiff joint that is fast.

    vmri simulate notebooks/scenes/robot_arm.py:scene --scheme explicit-slow --num-micro 10 --macro-dt 0.01 --steps 400 --save-micro --out robot_arm.npz
    vmri animate robot_arm.npz --out robot_arm.png --frames 4 --to 4 --view=-60,20
"""

import jax.numpy as jnp
import numpy as np

from vmri_jax.scene import Box, Cylinder, Gravity, JointDamper, JointDrive, JointSpring, Revolute, RigidBody, Scene

PILLAR, UPPER, LOWER, HAND = 0.6, 0.8, 0.6, 0.25  # m, heights and lengths
G = 9.81  # m/s^2
UPPER_MASS, LOWER_MASS, HAND_MASS = 8.0, 4.0, 2.0  # kg
BALANCE = 300.0  # N m/rad, of springs in shoulder and elbow that carry the weight at the start
ACROSS, UP = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])


def swing(t, params):
    """A torque that swings."""
    return params["torque"] * jnp.sin(params["rate"] * t)


shoulder = np.array([0.0, 0.0, PILLAR])
elbow = np.array([UPPER, 0.0, PILLAR])
wrist = np.array([UPPER + LOWER, 0.0, PILLAR])
arm = [
    (UPPER_MASS, UPPER / 2),
    (LOWER_MASS, UPPER + LOWER / 2),
    (HAND_MASS, UPPER + LOWER + HAND / 2),
]
"""Masses and distances from the shoulder."""
hold_shoulder = -G * sum(mass * way for mass, way in arm)
hold_elbow = -G * sum(mass * (way - UPPER) for mass, way in arm[1:])

scene = Scene(
    [
        RigidBody("pillar", 20.0, Cylinder(radius=0.12, length=PILLAR), shoulder / 2, pace="slow"),
        RigidBody("upper arm", UPPER_MASS, Box((UPPER, 0.1, 0.1)), (shoulder + elbow) / 2, pace="slow"),
        RigidBody("lower arm", LOWER_MASS, Box((LOWER, 0.08, 0.08)), (elbow + wrist) / 2, pace="slow"),
        RigidBody("hand", HAND_MASS, Box((HAND, 0.16, 0.03)), wrist + np.array([HAND / 2, 0.0, 0.0]), pace="fast"),
    ],
    [
        Gravity(),
        Revolute(("ground", "pillar"), [0.0, 0.0, 0.0], UP, name="base"),
        Revolute(("pillar", "upper arm"), shoulder, ACROSS, name="shoulder"),
        Revolute(("upper arm", "lower arm"), elbow, ACROSS, name="elbow"),
        Revolute(("lower arm", "hand"), wrist, ACROSS, name="wrist"),
        JointSpring("shoulder", BALANCE, hold_shoulder / BALANCE, name="shoulder balance"),
        JointSpring("elbow", BALANCE, hold_elbow / BALANCE, name="elbow balance"),
        JointDrive("base", swing, {"torque": 20.0, "rate": 2.0}, name="base motor"),
        JointDrive("shoulder", swing, {"torque": -120.0, "rate": 3.0}, name="shoulder motor"),
        JointDrive("elbow", swing, {"torque": 60.0, "rate": 4.0}, name="elbow motor"),
        JointDamper("base", 4.0, name="base damper"),
        JointDamper("shoulder", 15.0, name="shoulder damper"),
        JointDamper("elbow", 6.0, name="elbow damper"),
        JointSpring("wrist", 400.0, name="wrist spring"),
    ],
    coordinates="joint",
).with_joints({"wrist": (0.0, 4.0)})

"""What acts in a hinge, on a bar whose motion is known: springs, dampers, drives, limits, given motions."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import vmri_jax as vm
from vmri_jax.scene import (
    Cylinder,
    Gravity,
    JointDamper,
    JointDrive,
    JointLimit,
    JointMotion,
    JointSpring,
    Revolute,
    RigidBody,
    Scene,
)
from vmri_jax.scene.body import Pace
from vmri_jax.scene.rigid import angular_velocity

ONE = vm.fully_implicit(num_micro=1)
Y = np.array([0.0, 1.0, 0.0])


def pendulum(*effects, mass=2.0, length=0.7, tilt=0.5, pace: Pace = "slow", spin=0.0):
    """A bar that swings about the y axis through the origin."""
    bar = RigidBody(
        "bar",
        mass,
        Cylinder(0.1, 1.0),
        [length * np.sin(tilt), 0.0, -length * np.cos(tilt)],
        [0.0, -tilt, 0.0],
        spin=[0.0, -spin, 0.0],
        velocity=[spin * length * np.cos(tilt), 0.0, spin * length * np.sin(tilt)],
        pace=pace,
    )
    return Scene([bar], [Revolute(("ground", "bar"), [0.0, 0.0, 0.0], -Y, name="hinge"), *effects])


INERTIA = 2.0 * (3 * 0.1**2 + 1.0) / 12 + 2.0 * 0.7**2
"""Of `pendulum` about its hinge."""


def angles(scene, run):
    return scene.joint_motion(run, "hinge")


@pytest.mark.parametrize("pace", ["slow", "fast"])
def test_a_hinged_bar_is_the_compound_pendulum(pace):
    scene = pendulum(Gravity(), pace=pace)
    exact = solve_ivp(
        lambda t, y: [y[1], -2.0 * 9.81 * 0.7 / INERTIA * np.sin(y[0])], (0, 2), [0.5, 0.0], rtol=1e-11, atol=1e-12
    )
    errors = []
    for steps in (50, 100):
        run = vm.simulate(scene, ONE, macro_dt=2.0 / steps, num_steps=steps, save=steps // 50)
        errors.append(abs(0.5 + angles(scene, run)[-1] - exact.y[0, -1]))
    assert errors[1] < 7e-4  # measured 6.1e-4
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.05)


def test_a_spring_in_a_hinge_swings_harmonically():
    scene = pendulum(JointSpring("hinge", 30.0), spin=0.8)
    omega = np.sqrt(30.0 / INERTIA)
    run = vm.simulate(scene, vm.galerkin(num_micro=1, degree=2), macro_dt=0.02, num_steps=100)
    np.testing.assert_allclose(angles(scene, run), 0.8 / omega * np.sin(omega * np.asarray(run.t)), atol=5e-7)


def torque(t, params):
    return params["size"] * t


def test_a_drive_in_a_hinge_turns_it():
    scene = pendulum(JointDrive("hinge", torque, {"size": 3.0}))
    run = vm.simulate(scene, ONE, macro_dt=0.01, num_steps=100)
    np.testing.assert_allclose(angles(scene, run), 3.0 * np.asarray(run.t) ** 3 / 6 / INERTIA, atol=2e-4)
    assert abs(float(run.work().balance[-1])) < 1e-3


def test_a_damper_in_a_hinge_stops_it():
    scene = pendulum(JointDamper("hinge", 2.0), spin=0.8)
    run = vm.simulate(scene, ONE, macro_dt=0.01, num_steps=100)
    rate = -np.asarray(angular_velocity(run.position("bar"), run.velocity("bar")))[:, 1]
    np.testing.assert_allclose(rate, 0.8 * np.exp(-2.0 / INERTIA * np.asarray(run.t)), atol=1e-5)


def swing(t, params):
    return params["far"] * (1 - jnp.cos(t))


def test_the_motion_of_a_hinge_can_be_given():
    scene = pendulum(JointMotion("hinge", swing, {"far": 2.0}), Gravity())
    run = vm.simulate(scene, ONE, macro_dt=0.05, num_steps=100)
    np.testing.assert_allclose(np.sin(angles(scene, run)), np.sin(2.0 * (1 - np.cos(run.t))), atol=1e-12)
    with pytest.raises(ValueError, match=r"joint_motion: path\(0\) is .*; the joint starts at zero"):
        pendulum(JointMotion("hinge", lambda t, params: 1.0 + t))


def test_a_limit_of_a_hinge_turns_it_back():
    limit = JointLimit("hinge", -0.2, 0.3, stiffness=2000.0, smoothing=0.002)
    scene = pendulum(limit, spin=1.0)
    run = vm.simulate(scene, vm.galerkin(num_micro=1, degree=2), macro_dt=0.005, num_steps=300)
    seen = angles(scene, run)
    depth = np.sqrt(INERTIA / 2000.0)
    assert seen.max() == pytest.approx(0.3 + depth, abs=2e-3)
    assert seen.min() < -0.2
    assert np.ptp(run.energy) < 1e-4


def test_a_list_of_joints_is_refused():
    with pytest.raises(TypeError, match=r"joint_springs: joint is \['hinge', 'other'\]; give the name of one joint"):
        pendulum(JointSpring(["hinge", "other"], 1.0)).system()

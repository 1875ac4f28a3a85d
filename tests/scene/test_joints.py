"""Joints: what they leave free, what acts in them, and what cannot be joined."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import vmri_jax as vm
from vmri_jax.diagnostics import all_constraints
from vmri_jax.scene import (
    Body,
    Cylinder,
    Cylindrical,
    Fixed,
    Gravity,
    JointDamper,
    JointDrive,
    JointLimit,
    JointMotion,
    JointSpring,
    Prismatic,
    Revolute,
    RigidBody,
    Rod,
    Scene,
    Spherical,
    Universal,
)
from vmri_jax.scene.body import Pace
from vmri_jax.scene.effects.joints import slide, turn
from vmri_jax.scene.rigid import angular_velocity, rotation

MOMENTS = [1.0, 2.0, 2.5]
ONE = vm.fully_implicit(num_micro=1)
X, Y, Z = np.eye(3)
TILTED = [0.3, -0.2, 0.5]


def two_bodies(**of_b):
    """a at the origin, b one metre along x, both turned."""
    a = RigidBody("a", 2.0, MOMENTS, np.zeros(3), TILTED, spin=[0.2, 0.1, 0.3])
    return [a, RigidBody("b", 1.0, [0.5, 0.6, 0.7], X, [0.1, 0.4, -0.3], **of_b)]


def free(joint):
    """Number of relative motions that a joint leaves to two bodies."""
    scene = Scene(two_bodies(), [joint], project=True)
    return 12 - (scene.system().num_constraints(*scene.start[:2])[1] - 12)


AT = [0.6, 0.1, 0.2]


JOINTS = {
    "spherical": (Spherical(("a", "b"), AT), 3),
    "universal": (Universal(("a", "b"), AT, X, Y), 2),
    "revolute": (Revolute(("a", "b"), AT, [1.0, 2.0, 3.0]), 1),
    "fixed": (Fixed(("a", "b"), AT), 0),
    "cylindrical": (Cylindrical(("a", "b"), AT, Y), 2),
    "prismatic": (Prismatic(("a", "b"), AT, Y), 1),
}
MOVE_ELSEWHERE = ("spherical", "prismatic")
"""Joints of the slider-crank in `test_velocities`, whose motion is known: here their runs are for --full."""


@pytest.mark.parametrize("name", JOINTS)
def test_what_a_joint_leaves_free(name):
    joint, left = JOINTS[name]
    assert free(joint) == 6 + left


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.full if name in MOVE_ELSEWHERE else ()) for name in JOINTS]
)
def test_a_joint_holds_what_it_says_and_leaves_the_rest(name):
    joint, _ = JOINTS[name]
    scene = Scene(two_bodies(spin=[1.0, -2.0, 0.5], velocity=[0.1, 0.2, -0.3]), [joint], project=True)
    problem = scene.problem()
    state = problem.state()
    assert np.abs(all_constraints(problem.system, state)[0]).max() < 1e-15  # frames agree at the start
    run = vm.simulate(scene, ONE, macro_dt=0.05, num_steps=40)
    a, b = (run.position(name) for name in "ab")
    relative = np.einsum("kji,kjl->kil", rotation(a), rotation(b))
    assert np.abs(run.constraint_residual).max() < 1e-12
    assert np.ptp(run.energy) < 2e-3 * run.energy[0]
    turned = np.abs(relative - relative[0]).max()
    assert (turned > 0.05) == (not isinstance(joint, Fixed | Prismatic)), turned
    held = joint.parameters(scene.by_name)
    if isinstance(joint, Revolute | Cylindrical):
        axes = [held[f"frame_{role}"][2] @ q[:, 3:].reshape(-1, 3, 3) for role, q in zip("ab", (a, b), strict=True)]
        np.testing.assert_allclose(axes[0], axes[1], atol=1e-12)
        assert np.ptp(turn((a, b), held)) > 0.3
    if joint.slides:
        assert np.ptp(slide((a, b), held)) > 0.02


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
        run = vm.simulate(scene, ONE, macro_dt=2.0 / steps, num_steps=steps, save_every=steps // 50)
        errors.append(abs(0.5 + angles(scene, run)[-1] - exact.y[0, -1]))
    assert errors[1] < 5e-4
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


def test_the_motion_of_joints_is_read_by_name():
    scene = joined(Cylindrical(("a", "b"), AT, Y, name="pipe"))
    run = vm.simulate(Scene(scene.bodies, scene.effects, project=True), ONE, macro_dt=0.05, num_steps=10)
    assert scene.joint_motion(run, "pipe", "slide").shape == scene.joint_motion(run, "pipe", "turn").shape == (11,)
    with pytest.raises(ValueError, match=r"of is 'auto'; pipe leaves turn and slide free"):
        scene.joint_motion(run, "pipe")
    with pytest.raises(ValueError, match=r"Scene.joint_motion: there is no joint 'pip'. Did you mean pipe"):
        scene.joint_motion(run, "pip")
    pair = Revolute([("ground", "a"), ("a", "b")], [[0, 0, 0], AT], Y, name="chain")
    scene = Scene(two_bodies(), [pair], project=True)
    run = vm.simulate(scene, ONE, macro_dt=0.05, num_steps=10)
    first, second = (scene.joint_motion(run, "chain", pair=pair) for pair in (0, 1))
    assert np.abs(first - second).max() > 1e-3


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


def test_a_joint_between_a_slow_and_a_fast_body():
    """A hub that turns slowly with a stiff boom: constraints hold at the macro nodes, energy stays in a band of order two."""
    hub = RigidBody("hub", 50.0, [20.0, 20.0, 30.0], np.zeros(3), spin=[0.0, 0.0, 0.3], pace="slow")
    boom = RigidBody(
        "boom", 1.0, Cylinder(0.05, 2.0), [2.0, 0, 0], [0.0, np.pi / 2, 0.0], [0, 1.8, 0], [0, 0, 1.5], pace="fast"
    )
    hinge = Revolute((("hub", [1.0, 0, 0]), "boom"), axis=Z, name="root")
    scene = Scene([hub, boom], [hinge, JointSpring("root", 2000.0)])
    bands = []
    for steps in (20, 40):
        run = vm.simulate(
            scene, vm.fully_implicit(num_micro=10), macro_dt=1.0 / steps, num_steps=steps, save_every=steps // 20
        )
        assert np.abs(run.constraint_residual).max() < 1e-12
        bands.append(np.ptp(run.energy) / run.energy[0])
    assert scene.names.constraint == {"rigid boom": 6, "root": 5}
    assert bands[1] < 2e-2
    assert bands[0] / bands[1] > 3


def test_a_planar_loop_of_hinges_has_rows_too_many():
    def bar(name, start, end):
        start, end = np.asarray(start, float), np.asarray(end, float)
        along = end - start
        turned = np.arctan2(along[0], along[2])
        return RigidBody(name, 1.0, Cylinder(0.02, float(np.linalg.norm(along))), (start + end) / 2, [0.0, turned, 0.0])

    bars = [bar("crank", [0, 0, 0], [0, 0, 1]), bar("rod", [0, 0, 1], [1, 0, 1]), bar("rocker", [1, 0, 0], [1, 0, 1])]
    joints = [
        Revolute([("ground", "crank"), ("ground", "rocker")], [[0, 0, 0], [1, 0, 0]], Y, name="feet"),
        Revolute([("crank", "rod"), ("rod", "rocker")], [[0, 0, 1], [1, 0, 1]], Y, name="pins"),
    ]
    with pytest.raises(
        ValueError, match=r'feet ground-crank .* and 4 more are among 16 constraints of rank 13; .*redundant="drop"'
    ):
        Scene(bars, [Gravity(), *joints])
    scene = Scene(bars, [Gravity(), *joints], redundant="drop")
    assert len(scene.dropped) == 3
    assert not [name for name in scene.dropped if name.startswith("rigid")]
    assert sum(scene.names.slow_constraint.values()) == 36 - 1
    moved = scene.replace("crank", velocity=[0.5, 0, 0], spin=Y).replace("rocker", velocity=[0.5, 0, 0], spin=Y)
    run = vm.simulate(moved.replace("rod", velocity=[1.0, 0, 0]), ONE, macro_dt=0.01, num_steps=200)
    assert np.abs(run.constraint_residual).max() < 1e-12
    ends = [np.asarray(run.position(name))[:, :3] for name in ("crank", "rod", "rocker")]
    np.testing.assert_allclose(np.stack(ends)[..., 1], 0.0, atol=1e-12)  # what was left out is kept all the same
    assert Scene(bars[:1], joints[:0], redundant="drop").dropped == []


def test_a_fast_body_between_two_slow_ones_cannot_follow():
    bodies = [
        RigidBody("left", 1.0, MOMENTS, [0, 0, 0], pace="slow"),
        RigidBody("middle", 1.0, MOMENTS, [1, 0, 0], pace="fast"),
        RigidBody("right", 1.0, MOMENTS, [2, 0, 0], pace="slow"),
    ]
    joints = Spherical([("left", "middle"), ("middle", "right")], [[0.5, 0, 0], [1.5, 0, 0]])
    with pytest.raises(
        ValueError, match='only middle can move; leave one out, or make left or right fast too, pace="fast"'
    ):
        Scene(bodies, [joints])


def joined(*effects):
    return Scene(
        [
            *two_bodies(),
            Body("p", 1.0, [3.0, 0, 0]),
            Body("flat", 1.0, [3.0, 0]),
            RigidBody("rod", 1.0, Rod(1.0), [0, 2.0, 0]),
        ],
        effects,
    )


@pytest.mark.parametrize(
    ("effects", "message"),
    [
        (
            (Spherical((("a", [0.5, 0, 0]), ("b", [-0.6, 0, 0]))),),
            r"a-b is 0\.\d+; a \(0.5, 0, 0\) is at .*they must coincide",
        ),
        ((Spherical(("a", "b")),), r"nothing says where a and b are joined; give at=\[x, y, z\]"),
        ((Spherical((("a", [0.5, 0, 0]), "b"), [0.5, 0, 0]),), "at is given too; give one of them"),
        ((Revolute(("a", "p")),), "revolute: p is a point, which has no axes"),
        ((Spherical(("a", "flat"), [0, 0, 0]),), "spherical: flat has 2 coordinates; joints are between rigid bodies"),
        ((Revolute(("a", "rod"), [0, 2.0, 0]),), "revolute: .* sticks out of rod"),
        ((Revolute(("a", "b"), AT, [0, 0, 0]),), "axis is .*; it must not be zero"),
        ((Revolute(("a", "b"), AT, [0, 1.0]),), r"axis has shape \(2,\); give \(3,\)"),
        ((Universal(("a", "b"), AT, X, X),), "the axes must be perpendicular"),
        ((JointSpring("hinge", 1.0),), "joint_springs: .*'hinge'"),
        ((Spherical(("a", "b"), AT, name="ball"), JointSpring("ball", 1.0)), "ball leaves neither an angle nor a way"),
        (
            (Cylindrical(("a", "b"), AT, name="pipe"), JointSpring("pipe", 1.0)),
            "of is 'auto'; pipe leaves turn and slide free",
        ),
        ((Revolute(("a", "b"), AT, name="pin"), JointSpring("pin", -1.0)), "stiffness is -1.0; it must be positive"),
        (
            (Revolute(("a", "b"), AT, name="pin"), JointLimit("pin", 1.0, 0.5, stiffness=1.0, smoothing=0.1)),
            "lower is 1.0; it must be below upper",
        ),
    ],
)
def test_what_cannot_be_joined(effects, message):
    with pytest.raises(ValueError, match=message):
        joined(*effects)


def test_points_and_rods_hang_in_ball_joints():
    joints = Spherical([("a", "p"), ("a", "rod")], [[3.0, 0, 0], [0, 2.0, 0]])
    scene = joined(joints, Gravity()).replace("a", spin=None)
    assert vm.simulate(scene, ONE, macro_dt=0.02, num_steps=5).success

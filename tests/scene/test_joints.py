"""Joints: what they hold and leave free, how their motion is read, and what cannot be joined."""

import numpy as np
import pytest

import vmri_jax as vm
from tests.scene.mechanics import mechanics
from vmri_jax.diagnostics import all_constraints
from vmri_jax.scene import (
    Body,
    Cylindrical,
    Fixed,
    Gravity,
    JointLimit,
    JointSpring,
    Planar,
    Prismatic,
    Revolute,
    RigidBody,
    Rod,
    Scene,
    Screw,
    Spherical,
    Universal,
)
from vmri_jax.scene.rigid import rotation

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
    scene = Scene(two_bodies(), [joint], project=True, coordinates="directors")
    return 12 - (scene.system().num_constraints(*scene.start[:2])[1] - 12)


AT = [0.6, 0.1, 0.2]


JOINTS = {
    "spherical": (Spherical(("a", "b"), AT), 3),
    "universal": (Universal(("a", "b"), AT, X, Y), 2),
    "revolute": (Revolute(("a", "b"), AT, [1.0, 2.0, 3.0]), 1),
    "fixed": (Fixed(("a", "b"), AT), 0),
    "cylindrical": (Cylindrical(("a", "b"), AT, Y), 2),
    "prismatic": (Prismatic(("a", "b"), AT, Y), 1),
    "screw": (Screw(("a", "b"), AT, Y, 0.2), 1),
    "planar": (Planar(("a", "b"), AT, Y), 3),
}
RUN = "cylindrical"
"""The joint whose run is quick. That rows of all joints are zero along their freedoms is in `test_joint_coordinates`,
that they leave no more free in `test_what_a_joint_leaves_free`."""


@pytest.mark.parametrize("name", JOINTS)
def test_what_a_joint_leaves_free(name):
    joint, left = JOINTS[name]
    assert free(joint) == 6 + left


@pytest.mark.parametrize("name", [pytest.param(name, marks=() if name == RUN else pytest.mark.full) for name in JOINTS])
def test_a_joint_holds_what_it_says_and_leaves_the_rest(name):
    joint, _ = JOINTS[name]
    bodies = two_bodies(spin=[1.0, -2.0, 0.5], velocity=[0.1, 0.2, -0.3])
    scene = Scene(bodies, [joint], project=True, coordinates="directors")
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
    bound, q = joint.bound(scene.by_name), {"a": a, "b": b}
    if isinstance(joint, Revolute | Cylindrical):
        axes = [
            of_role[0, 3, 1:] @ q[:, 3:].reshape(-1, 3, 3) for of_role, q in zip(bound.vectors, (a, b), strict=True)
        ]
        np.testing.assert_allclose(axes[0], axes[1], atol=1e-12)
        assert np.ptp(bound.value("turn", 0, q)) > 0.3
    if "slide" in joint.freedoms:
        assert np.ptp(bound.value("slide", 0, q)) > 0.02


@pytest.mark.parametrize(("normal", "along", "across"), [(Z, X, Y), (Y, X, -Z), (X, Y, Z), (-Z, X, -Y)])
def test_axes_in_the_plane_of_a_joint_are_axes_of_space(normal, along, across):
    (axes,) = Planar(("a", "b"), AT, normal).bound(Scene(two_bodies()).by_name).triads
    np.testing.assert_allclose(axes, [along, across, normal], atol=1e-15)


def test_the_motion_of_joints_is_read_by_name():
    bodies = two_bodies(spin=[1.0, -2.0, 0.5], velocity=[0.1, 0.2, -0.3])
    scene = Scene(bodies, [Cylindrical(("a", "b"), AT, Y, name="pipe")], project=True, coordinates="directors")
    run = vm.simulate(scene, ONE, macro_dt=0.05, num_steps=40)
    assert scene.joint_motion(run, "pipe", "slide").shape == scene.joint_motion(run, "pipe", "turn").shape == (41,)
    with pytest.raises(ValueError, match=r"of is 'auto'; pipe leaves turn and slide free"):
        scene.joint_motion(run, "pipe")
    with pytest.raises(ValueError, match=r"Scene.joint_motion: there is no joint 'pip'. Did you mean pipe"):
        scene.joint_motion(run, "pip")
    pair = Revolute([("ground", "a"), ("a", "b")], [[0, 0, 0], AT], Y, name="chain")
    chain = Scene(two_bodies(), [pair], project=True, coordinates="directors")
    first, second = (chain.joint_motion(run, "chain", pair=pair) for pair in (0, 1))
    assert np.abs(first - second).max() > 1e-3


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
        ((Spherical((("a", [0.5, 0, 0]), ("b", [-0.6, 0, 0]))),), r"a-b is 0\.\d+; a \(0.5, 0, 0\) is at .*they must"),
        ((Spherical(("a", "b")),), r"nothing says where a and b are joined; give at=\[x, y, z\]"),
        ((Spherical((("a", [0.5, 0, 0]), "b"), [0.5, 0, 0]),), "at is given too; give one of them"),
        ((Revolute(("a", "p")),), "revolute: p is a point, which has no axes"),
        ((Spherical(("a", "flat"), [0, 0, 0]),), "spherical: flat has 2 coordinates; joints are between rigid bodies"),
        ((Revolute(("a", "rod"), [0, 2.0, 0]),), "revolute: .* sticks out of rod"),
        ((Revolute(("a", "b"), AT, [0, 0, 0]),), "axis is .*; it must not be zero"),
        ((Revolute(("a", "b"), AT, [0, 1.0]),), r"axis has shape \(2,\); give \(3,\)"),
        ((Universal(("a", "b"), AT, X, X),), "the axes must be perpendicular"),
        ((JointSpring("hinge", 1.0),), "joint_springs: .*'hinge'"),
        ((Spherical(("a", "b"), AT, name="ball"), JointSpring("ball", 1.0)), "ball leaves neither an angle nor a"),
        ((Cylindrical(("a", "b"), AT, name="pipe"), JointSpring("pipe", 1.0)), "of is 'auto'; pipe leaves turn and"),
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
    scene = joined(joints, Gravity())
    assert scene.names.rows.keys() >= {"spherical a-p", "spherical a-rod"}
    assert np.abs(mechanics(scene).rows).max() < 1e-13

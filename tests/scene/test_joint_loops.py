"""Joints between slow and fast bodies, and in loops."""

import jax
import numpy as np
import pytest

from tests.scene.mechanics import assert_mechanics_as_by_directors, mechanics
from vmri_jax import scene as sc

MOMENTS = [1.0, 2.0, 2.5]
X, Y, Z = np.eye(3)


def test_a_joint_between_a_slow_and_a_fast_body():
    """A hub that turns slowly with a stiff boom: the rows of the joint are held at the micro nodes, and their rates are
    zero at the start."""
    hub = sc.RigidBody("hub", 50.0, [20.0, 20.0, 30.0], np.zeros(3), spin=[0.0, 0.0, 0.3], pace="slow")
    boom = sc.RigidBody(
        "boom", 1.0, sc.Cylinder(0.05, 2.0), [2.0, 0, 0], [0.0, np.pi / 2, 0.0], [0, 1.8, 0], [0, 0, 1.5], pace="fast"
    )
    hinge = sc.Revolute((("hub", [1.0, 0, 0]), "boom"), axis=Z, name="root")
    scene = sc.Scene([hub, boom], [hinge, sc.JointSpring("root", 2000.0)], coordinates="directors")
    assert scene.names.constraint == {"rigid boom": 6, "root": 5}
    assert scene.names.slow_constraint == {"rigid hub": 6}
    assert np.abs(mechanics(scene).rows).max() < 1e-14
    assert np.abs(jax.jit(type(scene.system()).constraint_rates)(scene.system(), 0.0, *scene.start)).max() < 1e-13


def test_a_planar_loop_of_hinges_has_rows_too_many():
    def bar(name, start, end):
        start, end = np.asarray(start, float), np.asarray(end, float)
        along = end - start
        turned = np.arctan2(along[0], along[2])
        return sc.RigidBody(
            name, 1.0, sc.Cylinder(0.02, float(np.linalg.norm(along))), (start + end) / 2, [0.0, turned, 0.0]
        )

    bars = [bar("crank", [0, 0, 0], [0, 0, 1]), bar("rod", [0, 0, 1], [1, 0, 1]), bar("rocker", [1, 0, 0], [1, 0, 1])]
    joints = [
        sc.Revolute([("ground", "crank"), ("ground", "rocker")], [[0, 0, 0], [1, 0, 0]], Y, name="feet"),
        sc.Revolute([("crank", "rod"), ("rod", "rocker")], [[0, 0, 1], [1, 0, 1]], Y, name="pins"),
    ]
    with pytest.raises(ValueError, match=r"feet ground-crank .* and 6 more are among 16 constraints of rank 13"):
        sc.Scene(bars, [sc.Gravity(), *joints], coordinates="directors")
    scene = sc.Scene(bars, [sc.Gravity(), *joints], redundant="drop", coordinates="directors")
    assert len(scene.dropped) == 3
    assert not [name for name in scene.dropped if name.startswith("rigid")]
    assert sum(scene.names.slow_constraint.values()) == 36 - 1
    assert sc.Scene(bars[:1], joints[:0], redundant="drop").dropped == []


def test_a_fast_body_between_two_slow_ones_cannot_follow():
    bodies = [
        sc.RigidBody("left", 1.0, MOMENTS, [0, 0, 0], pace="slow"),
        sc.RigidBody("middle", 1.0, MOMENTS, [1, 0, 0], pace="fast"),
        sc.RigidBody("right", 1.0, MOMENTS, [2, 0, 0], pace="slow"),
    ]
    joints = sc.Spherical([("left", "middle"), ("middle", "right")], [[0.5, 0, 0], [1.5, 0, 0]])
    with pytest.raises(ValueError, match="only middle can move; leave one out, or make left or right fast too"):
        sc.Scene(bodies, [joints])


def test_a_stiff_spring_makes_its_loop_fast():
    """A slider-crank whose piston has a spring: without crank and rod the piston could not move on the micro grid."""
    pin, wrist = 0.3 * Y, 0.4 * X
    rod = sc.RigidBody("rod", 0.5, sc.Box((0.5, 0.02, 0.02)), (pin + wrist) / 2, -np.arctan2(0.3, 0.4) * Z)
    bodies = [
        sc.RigidBody("crank", 1.0, sc.Box((0.02, 0.3, 0.02)), pin / 2),
        rod,
        sc.RigidBody("piston", 0.8, sc.Box((0.06, 0.06, 0.06)), wrist),
    ]
    effects = [
        sc.Revolute(("ground", "crank"), [0, 0, 0], axis=Z, name="bearing"),
        sc.Revolute(("crank", "rod"), pin, axis=Z, name="crank pin"),
        sc.Revolute(("rod", "piston"), wrist, axis=Z, name="wrist pin"),
        sc.Prismatic(("ground", "piston"), wrist, axis=X, name="cylinder"),
        sc.JointSpring("cylinder", 1e4, neutral=0.05),
        sc.Gravity([0, -9.81, 0]),
    ]
    loop = sc.Scene(bodies, effects, redundant="drop", coordinates="joint")
    assert {name: pace.value for name, pace in loop.sorting.paces.items()} == dict.fromkeys(loop.by_name, "fast")
    reason = "tied by wrist pin to fast bodies, which cannot move without it"
    assert loop.sorting.paces["crank"].reason == loop.sorting.paces["rod"].reason == reason
    with pytest.raises(ValueError, match="where only piston can move; leave one out, or make crank or rod fast too"):
        loop.replace("crank", pace="slow").replace("rod", pace="slow")


BAR = sc.RigidBody("bar", 1.0, sc.Box((1, 0.1, 0.1)), [0.5, 0, 0])


def hinge(name, pairs=("ground", "bar")):
    """At the origin, about z."""
    return sc.Revolute(pairs, [0, 0, 0], axis=[0, 0, 1], name=name)


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        ([hinge("pin"), hinge("pin")], r"the name 'pin' occurs twice among bodies, effects and freedoms"),
        ([hinge("pin"), hinge("again", ("bar", "ground"))], r"pin ground-bar \[0\].* are 5 constraints of rank 0"),
        ([hinge("pin", [("ground", "bar")] * 2)], "join the same bodies: bar and ground by pin ground-bar and pin"),
    ],
)
def test_joints_that_are_given_twice_are_refused(joints, message):
    with pytest.raises(ValueError, match=message):
        sc.Scene([BAR], joints, coordinates="joint")


def test_a_joint_that_is_given_twice_may_be_dropped():
    scene = sc.Scene([BAR], [hinge("pin"), hinge("again")], coordinates="joint", redundant="drop")
    assert (len(scene.dropped), dict(scene.names.slow) | dict(scene.names.fast)) == (5, {"again": 1})


def test_what_hangs_on_the_ground_at_both_ends_is_one_tree():
    """The ground is the root, even of a body that is said to be slow, and the second way down to it closes a loop."""
    names, ends = ("left", "right"), [[-1, 0, 0], [0, 0.5, 0], [1, 0, 0]]
    bodies = [
        sc.RigidBody(name, 1.0, sc.Box((1, 0.1, 0.1)), np.add(*ends[i : i + 2]) / 2, pace="slow")
        for i, name in enumerate(names)
    ]
    pairs = ("ground", "left"), ("left", "right"), ("right", "ground")
    joints = [sc.Revolute(pair, at, axis=Z, name="-".join(pair)) for pair, at in zip(pairs, ends, strict=True)]
    slide = sc.Prismatic(("right", "ground"), ends[2], axis=X, name="slide")
    scene = sc.Scene(bodies, [*joints[:2], slide, sc.Gravity([0, -9.81, 0])], coordinates="joint", redundant="drop")
    assert [branch.parent for branch in scene.branches] == ["ground", "ground"]
    assert sum(x.size for x in scene.start[:2]) == 2
    with pytest.raises(ValueError, match="nearest velocities that fit the joints"):
        scene.replace("left", velocity=X).problem()  # no body floats
    assert sc.Scene(bodies[:1], joints[:1], coordinates="joint").branches[0].parent == "ground"


def test_a_universal_joint_goes_through_a_right_angle():
    """Where its axes on both bodies, or the axes of Euler angles, would be parallel."""
    bar = sc.RigidBody("bar", 1.0, sc.Box((0.1, 0.2, 1.0)), [0, 0, -0.5], pace="slow")
    cross = sc.Universal(("ground", "bar"), [0, 0, 0], axis=Z, second=X, name="cross")
    scene = sc.Scene([bar], [sc.Gravity(), cross], coordinates="joint")
    mass = jax.jit(jax.hessian(scene.system().kinetic_energy, argnums=2))
    for tilt in (1.3, np.pi / 2, 1.8):
        there = scene.with_joints({"cross": {"turn": (0.3, 2.0), "tilt": (tilt, 6.0)}})
        assert np.isfinite(there.start[0]).all()
        assert_mechanics_as_by_directors(there)
        assert np.linalg.cond(mass(*there.start)) < 100

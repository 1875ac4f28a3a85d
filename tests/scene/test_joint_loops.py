"""Joints between slow and fast bodies, and in loops."""

import numpy as np
import pytest

import vmri_jax as vm
from vmri_jax.scene import Cylinder, Gravity, JointSpring, Revolute, RigidBody, Scene, Spherical

MOMENTS = [1.0, 2.0, 2.5]
ONE = vm.fully_implicit(num_micro=1)
X, Y, Z = np.eye(3)


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

"""Several joints of one body, rotors and gears: the same accelerations as of joints and bodies that say the same
otherwise."""

from dataclasses import replace
from itertools import pairwise

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.body_motions import accelerations, state_of
from tests.scene.mechanics import assert_mechanics_as_by_directors, assert_same_mechanics, by_directors, mechanics
from vmri_jax import scene as sc
from vmri_jax.scene.effects.joint_base import AXES_OF

PLATE = sc.RigidBody("plate", 1.5, sc.Box((0.4, 0.6, 0.2)), [0.3, 0.2, 0.1])
HAND = sc.RigidBody("hand", 0.5, sc.Box((0.3, 0.1, 0.2)), [0.3, 0.7, 0.1])
WRIST = sc.Revolute(("plate", "hand"), [0.3, 0.5, 0.1], axis=[1.0, 0.2, 0.0], name="wrist")


def scene_of(bodies, effects):
    return sc.Scene([*bodies, PLATE, HAND], [*effects, WRIST, sc.Gravity([0.5, 0.3, -2.0])], coordinates="joint")


def test_joints_in_a_row_are_one_joint_of_several_freedoms():
    """Two hinges a cardan joint, two slides and a hinge one in a plane; springs and dampers of each freedom act
    alike."""
    axis, second = [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]  # the triad of a planar joint about z is (x, y, z)
    cases = [
        (
            sc.Universal(("ground", "plate"), [0, 0, 0], axis=axis, second=second, name="joint"),
            [sc.Revolute, sc.Revolute],
        ),
        (sc.Planar(("ground", "plate"), [0, 0, 0], axis=axis, name="joint"), [sc.Prismatic, sc.Prismatic, sc.Revolute]),
    ]
    for whole, kinds in cases:
        axes = whole.bound({PLATE.name: PLATE}).triads[0][[AXES_OF[freedom] for freedom in whole.freedoms]]
        frames = [sc.Frame(f"frame {i}", [0.1 * i, 0.2, 0.3]) for i in range(len(kinds) - 1)]
        names = ["ground", *(frame.name for frame in frames), "plate"]
        row = [
            kind(pair, [0, 0, 0], axis=along, name=f"joint {i}")
            for i, (kind, pair, along) in enumerate(zip(kinds, pairwise(names), axes, strict=True))
        ]
        first, *_, last = whole.freedoms
        one = scene_of([], [whole, sc.JointSpring("joint", 3.0, 0.1, of=first), sc.JointDamper("joint", 0.2, of=last)])
        other = scene_of(frames, [*row, sc.JointSpring("joint 0", 3.0, 0.1), sc.JointDamper(row[-1].name, 0.2)])
        for numbers in np.random.default_rng(0).normal(size=(3, len(kinds), 2)) / 2:
            starts = [tuple(start) for start in numbers]
            there = one.with_joints({"joint": dict(zip(whole.freedoms, starts, strict=True)), "wrist": (0.2, -0.6)})
            same = other.with_joints(
                {"wrist": (0.2, -0.6)} | {joint.name: start for joint, start in zip(row, starts, strict=True)}
            )
            values, expected = mechanics(same), mechanics(there)
            frameless = {name: values.bodies[name] for name in expected.bodies}
            assert_same_mechanics(values._replace(bodies=frameless), expected)


def driven():
    """A plate and its hand on hinges, with a rotor, a gear or a law between the two."""
    shoulder = sc.Revolute(("ground", "plate"), [0, 0, 0], axis=[0.2, 0.1, 1.0], name="shoulder")
    return scene_of([], [shoulder, sc.RotorInertia("shoulder", 0.7), sc.RotorInertia("wrist", 0.1, name="motor")])


def bend(x, params):
    """A row for two angles: the second is a polynomial of the first."""
    return x[1] - params["slope"] * x[0] - params["curve"] * x[0] ** 2


def test_rotors_and_couplings_are_the_same_by_directors():
    ties = [
        sc.Gear(["shoulder", "wrist"], ratios=[1.0, -2.0]),
        sc.JointCoupling(["shoulder", "wrist"], bend, {"slope": 0.5, "curve": 0.3}),
    ]
    assert_mechanics_as_by_directors(driven())
    assert driven().system().num_constraints(*driven().start[:2]) == (0, 0)
    for tie in ties:
        scene = replace(driven(), effects=[*driven().effects, tie])
        q_s, q_f, v_s, v_f = scene.start
        ours = mechanics(scene, (q_s + jnp.array([0.4, 0.3])[: q_s.size], q_f + 0.3, v_s, v_f))
        twin, there = by_directors(scene, ours.bodies)
        (row,) = twin.names.rows[tie.name]
        assert ours.rows.shape == (1,)
        assert abs(ours.rows[0]) > 0.01
        assert mechanics(twin, there).rows[row] == pytest.approx(ours.rows[0], abs=1e-12)


def test_a_joint_follows_by_its_gear():
    scene = replace(driven(), effects=[*driven().effects, sc.Gear(["shoulder", "wrist"], ratios=[1.0, -2.0])])
    start = scene.with_joints({"shoulder": (0.4, 0.8)}).start
    np.testing.assert_allclose(np.concatenate(start), [0.4, 0.2, 0.8, 0.4], atol=1e-15)
    with pytest.raises(ValueError, match=r"keeps gear .*stays open by 0\.2"):
        scene.with_joints({"shoulder": 0.4, "wrist": 0.3})


def test_a_rotor_slows_a_pendulum():
    """A point of mass m at the length l with a rotor J in its hinge: ``(m l^2 + J) x'' = -m g l sin x``."""
    bob = sc.RigidBody("bob", 2.0, (1e-9, 1e-9, 1e-9), [0.5, 0.0, 0.0])
    hinge = sc.Revolute(("ground", "bob"), [0, 0, 0], axis=[0, 1, 0], name="hinge")
    scene = sc.Scene([bob], [hinge, sc.RotorInertia("hinge", 1.5), sc.Gravity([0, 0, -10.0])], coordinates="joint")
    a = accelerations(scene, state_of(scene))["bob"][2][:3]
    np.testing.assert_allclose(a, [0.0, 0.0, -10.0 * 2.0 * 0.5**2 / (2.0 * 0.5**2 + 1.5)], atol=1e-8)


def test_frames_have_no_unknowns_and_are_not_drawn():
    """A gimbal whose micro steps are taken by the hand."""
    frame = sc.Frame("yoke", [0, 0, 0])
    row = [
        sc.Revolute(("ground", "yoke"), [0, 0, 0], axis=[0, 0, 1], name="pan"),
        sc.Revolute(("yoke", "plate"), [0, 0, 0], axis=[1, 0, 0], name="tilt"),
    ]
    hand = replace(HAND, pace="fast")
    scene = sc.Scene(
        [frame, PLATE, hand],
        [*row, WRIST, sc.JointSpring("wrist", 5.0), sc.Gravity([0, 0, -9.81])],
        coordinates="joint",
    )
    assert (scene.names.slow, scene.names.fast) == ({"pan": 1, "tilt": 1}, {"wrist": 1})
    drawn = [entry["name"] for kind in ("bodies", "solids") for entry in scene.drawing()[kind]]
    assert "plate" in drawn
    assert "yoke" not in drawn


def test_frames_that_cannot_move_are_refused():
    frame, pan = sc.Frame("yoke", [0, 0, 0]), sc.Revolute(("ground", "yoke"), [0, 0, 0], name="pan")
    tilt = sc.Revolute(("yoke", "plate"), [0, 0, 0], axis=[1, 0, 0], name="tilt")
    with pytest.raises(ValueError, match=r'yoke is a frame without mass.*coordinates="joint"'):
        sc.Scene([frame, PLATE], [pan, tilt], coordinates="directors")
    with pytest.raises(ValueError, match=r"the frame yoke carries no body"):
        sc.Scene([frame, PLATE], [pan, replace(tilt, between=("ground", "plate"))], coordinates="joint")
    with pytest.raises(ValueError, match=r"no joint carries the frame yoke, and it has no mass"):
        sc.Scene([frame, PLATE], [replace(tilt, between=("ground", "plate"))], coordinates="joint")
    scene = sc.Scene([frame, PLATE], [pan, tilt], coordinates="joint")
    with pytest.raises(ValueError, match=r"yoke is a frame without mass.*not by directors.*For reaction forces"):
        scene.by_directors(None)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"Frame yoke: position has shape \(2,\); give \(3,\)"):
        sc.Frame("yoke", [0, 1])


def two_values(x, params):
    return jnp.ones((2, 2)) * x[0]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: sc.Gear([], ratios=[1.0]), r"joints is \[\]; give names of 1 to 16"),
        (lambda: sc.Gear(["shoulder", "elbow"], ratios=[1.0, 2.0]), r"gear: there is no joint 'elbow'"),
        (lambda: sc.Gear(["shoulder", "wrist"], ratios=[1.0]), r"ratios is \[1.\]; give one for each"),
        (lambda: sc.Gear(["shoulder", "wrist"], ratios=[1.0, 0.0]), r"none of them may be zero"),
        (lambda: sc.Gear(["shoulder", ("wrist", "slide")], ratios=[1.0, 2.0]), r"wrist leaves turn free"),
        (lambda: sc.JointCoupling(["shoulder", "wrist"], two_values), r"law returns .*\(2, 2\).*one value"),
        (
            lambda: sc.JointCoupling(["shoulder", "wrist"], lambda x, params: x[0] - x[1] + 0.1),
            r"violate coupling.* 0.1;",
        ),
        (lambda: sc.JointCoupling(["shoulder", "wrist"], lambda x: x[0]), r"law .*x, params"),
        (lambda: sc.RotorInertia("shoulder", -1.0, name="more"), r"inertia is -1.0; it must be positive"),
    ],
)
def test_bad_input(make, message):
    with pytest.raises((ValueError, TypeError), match=message):
        replace(driven(), effects=[*driven().effects, make()])

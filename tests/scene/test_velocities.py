"""Velocities of all bodies from the rates of a few joints."""

import jax
import numpy as np
import pytest

from vmri_jax import Refused
from vmri_jax import scene as sc

R, L, ANGLE = 0.1, 0.3, 0.7
"""Of the crank, of the rod, and the angle of the crank, m, m, rad."""
Z = np.array([0.0, 0.0, 1.0])


def slider_crank() -> sc.Scene:
    """At rest, at an angle where everything moves."""
    pin = R * np.array([np.cos(ANGLE), np.sin(ANGLE), 0.0])
    tilt = -np.arcsin(R * np.sin(ANGLE) / L)
    wrist = pin + L * np.array([np.cos(tilt), np.sin(tilt), 0.0])
    return sc.Scene(
        [
            sc.RigidBody("crank", 1.0, sc.Box((R, 0.02, 0.02)), pin / 2, ANGLE * Z),
            sc.RigidBody("rod", 0.5, sc.Rod(L), (pin + wrist) / 2, _along(wrist - pin)),
            sc.RigidBody("piston", 0.8, sc.Box((0.06, 0.06, 0.06)), wrist),
        ],
        [
            sc.Revolute(("ground", "crank"), at=[0.0, 0.0, 0.0], axis=Z, name="bearing"),
            sc.Spherical(("crank", "rod"), at=pin, name="crank pin"),
            sc.Spherical(("rod", "piston"), at=wrist, name="wrist pin"),
            sc.Prismatic(("ground", "piston"), at=wrist, axis=[1.0, 0.0, 0.0], name="cylinder"),
        ],
    )


def _along(direction) -> np.ndarray:
    """A rotation whose third axis, that of a rod, is along a vector in the plane."""
    n = direction / np.linalg.norm(direction)
    return np.column_stack([Z, np.cross(n, Z), n])


def test_a_crank_takes_its_rod_and_piston_with_it():
    speed = 100.0
    scene = slider_crank().with_rates({"bearing": speed})
    crank, rod, piston = scene.bodies
    across = R * np.sin(ANGLE)
    lean = np.arcsin(across / L)
    turning = -speed * R * np.cos(ANGLE) / (L * np.cos(lean))  # of the rod
    pushed = -speed * (across + R * np.cos(ANGLE) * np.tan(lean))  # of the piston
    np.testing.assert_allclose(crank.spin, speed * Z, atol=1e-10)
    np.testing.assert_allclose(rod.spin, turning * Z, atol=1e-10)
    np.testing.assert_allclose(piston.velocity, [pushed, 0.0, 0.0], atol=1e-11)


def test_rates_of_the_piston_give_those_of_the_crank():
    there = slider_crank().with_rates({"bearing": 3.0})
    back = slider_crank().with_rates({"cylinder": there.bodies[2].velocity[0]})
    np.testing.assert_allclose(back.bodies[0].spin, 3.0 * Z, atol=1e-12)
    np.testing.assert_allclose(there.with_rates({"bearing": 0.0}).bodies[0].spin, 0.0, atol=1e-12)


def test_what_rates_leave_open_stays_as_it_is():
    hub = sc.RigidBody("hub", 5.0, sc.Box((1.0, 1.0, 1.0)), [0.0, 0.0, 0.0], velocity=[0.3, 0.0, 0.0])
    arm = sc.RigidBody("arm", 1.0, sc.Box((1.0, 0.1, 0.1)), [1.0, 0.0, 0.0])
    free = sc.Scene(
        [hub, arm], [sc.Cylindrical(("hub", "arm"), at=[0.5, 0.0, 0.0], axis=[1.0, 0.0, 0.0], name="guide")]
    )
    moved = free.with_rates({"guide": {"turn": 2.0, "slide": 0.6}})
    a, b = moved.bodies
    np.testing.assert_allclose(b.spin - a.spin, [2.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(b.velocity - a.velocity, [0.6, 0.0, 0.0], atol=1e-12)
    total = 5.0 * a.velocity + b.velocity  # a change of rates inside takes no momentum from outside
    np.testing.assert_allclose(total, [1.5, 0.0, 0.0], atol=1e-12)


def test_motions_that_are_given_count():
    def steady(t, params):
        return params["speed"] * t

    base = slider_crank()
    driven = sc.Scene(base.bodies, [*base.effects, sc.JointMotion("bearing", steady, {"speed": 7.0})])
    np.testing.assert_allclose(driven.with_rates({}).bodies[0].spin, 7.0 * Z, atol=1e-12)
    with pytest.raises(ValueError, match="no velocities have these rates of bearing and keep the constraints"):
        driven.with_rates({"bearing": 8.0})


def test_velocities_of_bodies_and_of_joints_do_not_hide_each_other():
    bar = sc.RigidBody("bar", 1.0, sc.Box((1.0, 0.1, 0.1)), [0.0, 0.0, 0.0])
    scene = sc.Scene([bar], [sc.Revolute(("ground", "bar"), at=[0.0, 0.0, 0.0], axis=Z, name="hinge")])
    assert scene.with_rates({"hinge": 3.0}).replace("bar", spin=5.0 * Z).start[2] == pytest.approx(5.0)
    turned = scene.with_joints({"hinge": (0.1, 2.0)})
    with pytest.raises(ValueError, match=r"bar: spin would change nothing, because .* has set the rate of hinge"):
        turned.replace("bar", spin=5.0 * Z)
    with pytest.raises(ValueError, match="with_joints has set a start of hinge, which has no coordinate in this scene"):
        turned.without("hinge")


def test_every_pair_of_a_joint_has_a_rate():
    links = [sc.RigidBody(f"link {k}", 1.0, sc.Box((1.0, 0.1, 0.1)), [k + 0.5, 0.0, 0.0]) for k in range(2)]
    pairs = sc.Revolute([("ground", "link 0"), ("link 0", "link 1")], [[0, 0, 0], [1, 0, 0]], axis=Z, name="hinges")
    chain = sc.Scene(links, [pairs], coordinates="directors").with_rates({"hinges": [1.0, -3.0]})
    np.testing.assert_allclose([body.spin for body in chain.bodies], [Z, -2.0 * Z], atol=1e-12)
    np.testing.assert_allclose(sc.rotation(chain.start[0][:12]), np.eye(3), atol=1e-15)


@pytest.mark.parametrize(
    ("rates", "message"),
    [
        (3.0, 'Scene.with_rates: got 3.0; give numbers by the names of joints, {"hinge": 0.3}'),
        ({"bering": 1.0}, "there is no joint 'bering'.*bearing"),
        ({"crank pin": 1.0}, "crank pin leaves neither an angle nor a displacement"),
        ({"bearing": {"slide": 1.0}}, "of is 'slide'; bearing leaves turn free"),
        ({"bearing": [1.0, 2.0]}, r"the rate of bearing has shape \(2,\); give one number"),
        ({"bearing": np.nan}, "the rate of bearing is nan; it must be finite"),
        ({"bearing": "fast"}, "the rate of bearing"),
        ({"bearing": 1.0, "cylinder": 1.0}, "no velocities have these rates of bearing, cylinder"),
    ],
)
def test_bad_rates_are_refused(rates, message):
    with pytest.raises(Refused, match=message):
        slider_crank().with_rates(rates)


def test_traced_rates_are_refused():
    with pytest.raises(Refused, match=r"traces numbers of the scene or rates; call with_rates outside"):
        jax.grad(lambda rate: slider_crank().with_rates({"bearing": rate}).bodies[0].spin[2])(1.0)

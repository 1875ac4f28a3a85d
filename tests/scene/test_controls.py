"""Controls of scenes: their generalised forces, that runs do not see them, and what is refused."""

import jax
import numpy as np
import pytest

import vmri_jax as vm
from tests.scene.mechanics import assert_same_mechanics, mechanics
from vmri_jax import scene as sc

HUB = sc.RigidBody("hub", 3.0, sc.Box((1.0, 0.8, 0.6)), [0.0, 0.0, 0.0], pace="slow")
TURNED = sc.RigidBody("hub", 3.0, sc.Box((1.0, 0.8, 0.6)), [0.0, 0.0, 0.0], [0.3, 0.2, -0.5], pace="slow")
WHEEL = sc.RigidBody("wheel", 2.0, sc.Ball(0.2), [1.0, 0.0, 0.0], pace="fast")
POINT = sc.Body("point", 1.0, [0.0, 2.0], pace="fast")


def rates_of_momenta(scene: sc.Scene, u):
    """Resultant force and moment about the origin of controls on each rigid body."""
    actuate = scene.actuation
    q_s, q_f, *_ = scene.start
    assert actuate is not None
    forces = jax.jit(lambda u: actuate(q_s, q_f, u, scene.system().params))(np.asarray(u))
    forces = dict(zip("sf", map(np.asarray, forces), strict=True))
    positions = {"s": q_s, "f": q_f}
    found = {}
    for name, place in scene.places.items():
        if scene.by_name[name].rigid:
            at = slice(place.start, place.start + place.size)
            q, f = positions[place.part][at], forces[place.part][at]
            found[name] = f[:3], sc.angular_momentum(q, f)
    return found


def test_a_torque_turns_and_does_not_push():
    u = [1.0, 2.0, 3.0]
    in_space, in_body = sc.Controlled("hub", "torque"), sc.Controlled("hub", "torque", axes="body")
    for control, expected in ((in_space, u), (in_body, TURNED.rotation @ u)):
        force, moment = rates_of_momenta(sc.Scene([TURNED], [control]), u)["hub"]
        np.testing.assert_allclose(force, 0.0, atol=1e-14)
        np.testing.assert_allclose(moment, expected, atol=1e-14)


def test_a_force_at_a_point_of_a_body():
    scene = sc.Scene([TURNED], [sc.Controlled(("hub", [0.5, 0.1, 0.0]), "force", along=[0.0, 2.0, 0.0], axes="body")])
    force, moment = rates_of_momenta(scene, [3.0])["hub"]
    arm, along = TURNED.rotation @ [0.5, 0.1, 0.0], TURNED.rotation @ [0.0, 1.0, 0.0]
    np.testing.assert_allclose(force, 3.0 * along, atol=1e-14)
    np.testing.assert_allclose(moment, 3.0 * np.cross(arm, along), atol=1e-14)


def test_a_torque_in_a_joint_has_its_opposite():
    bearing = sc.Revolute(("hub", "wheel"), [1.0, 0.0, 0.0], axis=[1.0, 0.0, 0.0], name="bearing")
    rates = rates_of_momenta(
        sc.Scene([HUB, WHEEL], [bearing, sc.Controlled("bearing", "torque")], project=True, coordinates="directors"),
        [2.5],
    )
    np.testing.assert_allclose(rates["wheel"][1], [2.5, 0.0, 0.0], atol=1e-13)
    np.testing.assert_allclose(rates["hub"][1], [-2.5, 0.0, 0.0], atol=1e-13)
    np.testing.assert_allclose(rates["hub"][0], 0.0, atol=1e-13)


def test_a_force_in_a_slide():
    slide = sc.Prismatic(("ground", "wheel"), [1.0, 0.0, 0.0], axis=[0.0, 1.0, 0.0], name="slide")
    force, _ = rates_of_momenta(
        sc.Scene([WHEEL], [slide, sc.Controlled("slide", "force")], coordinates="directors"), [2.0]
    )["wheel"]
    np.testing.assert_allclose(force, [0.0, 2.0, 0.0], atol=1e-13)


def test_names_and_order():
    scene = sc.Scene(
        [HUB, POINT],
        [sc.Controlled("hub", "torque"), sc.Controlled("point", "force"), sc.Controlled("hub", along=[1, 0, 0])],
    )
    assert scene.actuation is not None
    axes = *(f"hub torque {axis}" for axis in "xyz"), "point force x", "point force y"
    assert scene.actuation.labels == (*axes, "hub force")


def test_a_run_does_not_see_them():
    plain, controlled = sc.Scene([HUB, POINT]), sc.Scene([HUB, POINT], [sc.Controlled("hub", "torque")])
    assert controlled.system().force is None
    assert plain.actuation is None
    assert [term.name for term in controlled.system().terms] == [term.name for term in plain.system().terms]
    assert_same_mechanics(mechanics(controlled), mechanics(plain))
    row = next(row for row in controlled.explain(vm.fully_explicit(2), measure=False).rows if row.kind == "control u")
    assert row.evaluations == 0


@pytest.mark.parametrize(
    ("bodies", "effects", "message"),
    [
        ([HUB], [sc.Controlled("hab", "torque")], "hab torque: there is no body 'hab'"),
        ([POINT], [sc.Controlled("point", "torque")], "point has no directors; a torque needs a rigid body with three"),
        ([POINT], [sc.Controlled(("point", [1.0, 0.0]), "force")], "point is no rigid body"),
        ([HUB], [sc.Controlled(("hub", [1.0, 0.0]), "force")], r"the point in hub has shape \(2,\)"),
        ([HUB], [sc.Controlled("hub", "torque", along=[1.0, 0.0])], r"along has shape \(2,\)"),
        ([HUB], [sc.Controlled("hub", "torque", along=[0.0, 0.0, 0.0])], "it must have a direction"),
        (
            [sc.RigidBody("rod", 1.0, sc.Rod(1.0), [0.0, 0.0, 0.0])],
            [sc.Controlled("rod", "torque")],
            "rod has 1 of three directors",
        ),
        (
            [HUB, WHEEL],
            [
                sc.Revolute(("hub", "wheel"), [1.0, 0.0, 0.0], axis=[1.0, 0.0, 0.0], name="bearing"),
                sc.Controlled("bearing", "force"),
            ],
            "of is 'slide'; bearing leaves turn free",
        ),
        (
            [HUB, WHEEL],
            [
                sc.Revolute(("hub", "wheel"), [1.0, 0.0, 0.0], axis=[1.0, 0.0, 0.0], name="bearing"),
                sc.Controlled("bearing", "torque", along=[1.0, 0.0, 0.0]),
            ],
            "a joint has an axis of its own",
        ),
        ([HUB, POINT], [sc.Controlled(["hub", "point"], "force")], "give one body or joint"),
    ],
)
def test_bad_input(bodies, effects, message):
    with pytest.raises(ValueError, match=message):
        sc.Scene(bodies, effects, project=True)


@pytest.mark.parametrize(("argument", "given"), [("load", "push"), ("axes", "wheel")])
def test_bad_words(argument, given):
    with pytest.raises(ValueError, match=f"{argument} is '{given}'; it must be"):
        sc.Controlled("hub", **{argument: given})

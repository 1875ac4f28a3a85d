# pyright: reportArgumentType=false
"""Scenes that are wrong say what is wrong, with which names, before anything is computed."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vmri_jax import Problem, Refused
from vmri_jax.scene import (
    Anchor,
    Angle,
    Ball,
    Body,
    Constraint,
    Coulomb,
    Cylindrical,
    Drive,
    Effect,
    Force,
    Gravity,
    Guide,
    HarmonicDrive,
    Kinetic,
    LinearDamping,
    MagneticField,
    MovingPivot,
    PlaneContact,
    Potential,
    RigidBody,
    RigidLink,
    Scene,
    Spring,
    SpringAnchor,
    Torsion,
)
from vmri_jax.scene.declare import names


def still(t, params):
    return jnp.zeros(2)


A, B, C = Body("bob", 1.0, [0.0, 0.0]), Body("tip", 1.0, [1.0, 0.0]), Body("load", 1.0, [1.0, 1.0])
SPACE = [Body(name, 1.0, q) for name, q in zip("wxyz", np.eye(4)[:, :3] + 1, strict=True)]


def height(q, params):
    return q[0][1]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("a", 1.0, [1.0], None, "slow", -1.0), r"Body a: radius is -1.0; it must be a positive number"),
        (("a", 0.0, [1.0]), r"Body a: mass is 0.0; every mass must be positive"),
        (("a", [1.0, -2.0], [1.0, 1.0]), r"Body a: mass is \[ 1. -2.\]"),
        (("a", [1.0, 2.0], [1.0]), r"Body a: mass has shape \(2,\); give one number, or one for each of 1 coordinates"),
        (("a", 1.0, [np.nan]), "Body a: position is .*not finite"),
        (("a", 1.0, [[1.0]]), r"Body a: position has shape \(1, 1\); give a vector"),
        (("a", 1.0, [1.0], [1.0, 2.0]), r"Body a: velocity has shape \(2,\), position has \(1,\)"),
        (("a", 1.0, [1.0], None, "quick"), "Body a: pace is 'quick'; it must be 'slow', 'fast' or 'auto'"),
        (("", 1.0, [1.0]), "Body: name is ''"),
    ],
)
def test_body(arguments, message):
    with pytest.raises(ValueError, match=message):
        Body(*arguments)


@pytest.mark.parametrize(
    ("bodies", "effects", "message"),
    [
        ([], [], "there are no bodies"),
        ([A, A], [], "the name 'bob' occurs twice"),
        ([A, B], [Gravity(), Gravity()], "the name 'gravity' occurs twice.*name="),
        ([A, B], [Gravity(name="bob")], "the name 'bob' occurs twice"),
        (
            [RigidBody("pipe turn", 1.0, [1.0, 1.0, 1.0], np.zeros(3))],
            [Cylindrical(("ground", "pipe turn"), np.zeros(3), name="pipe")],
            "the name 'pipe turn' occurs twice.*freedoms of joints",
        ),
        ([A], [Gravity(name="mass")], "an effect is called 'mass'"),
        ([A, B], [Spring(("bob", "tipp"), 1.0)], "springs: there is no body 'tipp'. Did you mean tip\\?"),
        ([A, B], [Spring(("bob", "bob"), 1.0)], "springs: bob occurs twice"),
        ([A, B, C], [Spring(("bob", "tip", "load"), 1.0)], "springs: between is .*give 2 names of bodies"),
        ([A, B], [Spring(("bob", "tip"), -1.0)], "springs: stiffness is -1.0; it must be positive"),
        ([A, B], [Spring(("bob", "tip"), 1.0, 0.0)], "springs: length is 0.0; it must be positive"),
        ([A, B], [Spring(("bob", "tip"), [1.0, 2.0])], r"springs: stiffness has shape \(2,\); give one number"),
        ([A, B], [Gravity([0.0, 0.0, 1.0])], r"gravity: acceleration has shape \(3,\), bob has dimension 2"),
        ([A, Body("x", 1.0, [0.0, 0.0])], [RigidLink(("bob", "x"))], "links: the distance of bob and x is 0.0"),
        ([A, B], [RigidLink(("bob", "tip"), -1.0)], "links: length is -1.0; it must be positive"),
        ([A, B], [RigidLink(("bob", "tip"), 2.0)], "links: length of bob-tip is 2; it starts as 1; give this value"),
        ([A, B], [Guide("tip", still)], r"positions at the start violate guides tip \[0\] by 1; move"),
        ([A, B], [MovingPivot("tip", still, 7.0)], "moving_pivots: length of tip is 7; it starts as .*; give this"),
        ([A, B], [MovingPivot("tip", still, -2.0)], "moving_pivots: length is -2.0; it must be positive"),
        (SPACE[:1], [MovingPivot("w", still)], r"moving_pivots: path returns shape \(2,\); w has dimension 3"),
        ([A, SPACE[0]], [RigidLink(("bob", "w"))], r"links: bodies of different dimension \(bob 2, w 3\)"),
        ([A, SPACE[0]], [SpringAnchor(["bob", "w"], [0.0, 0.0], 1.0)], r"spring_anchors: bodies of different"),
        ([A], [Anchor("bob", [0.0, 0.0])], "anchors: the distance of a body from its point is 0.0"),
        ([A], [Anchor("bob", [0.0, 0.0, 1.0])], r"anchors: point has shape \(3,\); its bodies have dimension 2"),
        ([B], [Anchor("tip", [0.0, 0.0], 3.0)], "anchors: length of tip is 3; it starts as 1; give this value"),
        (
            [Body("block", 1.0, np.ones(5)), Body("b", 1.0, np.zeros(5))],
            [Spring(("block", "b"), 1.0)],
            "springs: block has 5 general coordinates",
        ),
        (
            [Body("modes", 1.0, np.ones(2), block=True), A],
            [Spring(("modes", "bob"), 1.0)],
            "springs: modes has 2 general coordinates; this effect is between points",
        ),
        (
            [Body(f"b{i}", 1.0, [float(i)]) for i in range(33)],
            [Potential(height, tuple(f"b{i}" for i in range(33)))],
            "height: an element of 33 bodies, b0, b1, b2, ...; at most 32 bodies may share a function",
        ),
        ([A], [LinearDamping(0.0)], "damping: coefficient is 0.0; it must be positive"),
        ([A], [HarmonicDrive("bob", [1.0], 1.0)], r"harmonic_drive: amplitude has shape \(1,\)"),
        ([A], [PlaneContact(point=[0, 0], normal=[0, 0], stiffness=1.0, smoothing=1.0)], "plane_contact: normal is"),
        ([A, B], [Coulomb({"bob": 1.0}, 1.0, [("bob", "tip")])], "coulomb: tip has no charge"),
        ([A], [MagneticField([0.0, 0.0, 1.0], 1.0)], r"magnetic_field: field has shape \(3,\) and bob has dimension 2"),
        ([A, B, Body("c", 1.0, [2.0, 0.0])], [Angle(("bob", "tip", "c"), 1.0)], "angles: angle is .*take Bending"),
        ([A, B], [Potential(height, "bob", drawn_as="spring")], "height: drawn_as is 'spring'; it is drawn between"),
        (
            [A, Body("block", 1.0, np.ones(4))],
            [Potential(height, ("bob", "block"), drawn_as="link")],
            "height: drawn_as is 'link'; it is drawn between points, and block has 4 coordinates; leave it out",
        ),
        (SPACE, [Torsion(("w", "x", "y", "z"), 1.0, 0.0, 1.5)], "torsion: multiplicity is 1.5; it must be an integer"),
    ],
)
def test_scene(bodies, effects, message):
    with pytest.raises(ValueError, match=message):
        Scene(bodies, effects)


def test_wrong_kinds():
    with pytest.raises(TypeError, match=r"Scene: bodies is .*give a list"):
        Scene(A)
    with pytest.raises(TypeError, match=r"effects has 'gravity'; each must be Effect"):
        Scene([A], ["gravity"])
    with pytest.raises(TypeError, match=r"Potential: function is 3"):
        Potential(3, "bob")
    with pytest.raises(ValueError, match=r"springs: rate is 'stiff'"):
        Spring(("bob", "tip"), 1.0, rate="stiff")
    with pytest.raises(ValueError, match=r"height: drawn_as is 'rope'; it must be 'link', 'spring' or None"):
        Potential(height, ("bob", "tip"), drawn_as="rope")
    for kind, arguments in ((Anchor, ()), (SpringAnchor, (1.0,))):
        with pytest.raises(TypeError, match=r"anchors: point is <function height.* that moves take MovingPivot"):
            kind("bob", height, *arguments)
    with pytest.raises(TypeError, match=r"guides: path is \[0.0, 1.0\]; give a function of \(t, params\)"):
        Scene([A], [Guide("bob", [0.0, 1.0])])
    with pytest.raises(TypeError, match=r"Scene.explain: scheme is 'galerkin'"):
        Scene([A]).explain("galerkin", measure=False)


SQUARE = [Body(name, 1.0, q, pace="slow") for name, q in zip("abcd", [[0, 0], [1, 0], [1, 1], [0, 1]], strict=True)]
SIDES = [("a", "b"), ("b", "c"), ("c", "d"), ("d", "a"), ("a", "c"), ("b", "d")]


def test_redundant_links_are_named():
    Scene(SQUARE, [RigidLink(SIDES[:5])])
    with pytest.raises(ValueError, match=r"over-constrained at the start: links a-b, .*links b-d are 6 constraints of"):
        Scene(SQUARE, [RigidLink(SIDES)])
    with pytest.raises(ValueError, match=r"links a-b, again a-b are 2 constraints of rank 1; leave one of them out"):
        Scene(SQUARE, [RigidLink(SIDES[:2]), RigidLink(("a", "b"), name="again")])


def test_links_that_the_fast_bodies_cannot_keep_are_named():
    bodies = [*SQUARE[:3], Body("d", 1.0, [0.0, 1.0], pace="fast")]
    Scene(bodies, [RigidLink([("a", "d"), ("c", "d")])])
    with pytest.raises(ValueError, match=r"links a-d, links c-d, links b-d are 3 constraints of rank 2"):
        Scene(bodies, [RigidLink([("a", "d"), ("c", "d"), ("b", "d")])])


def test_unknown_names_come_with_the_near_miss():
    scene = Scene([A, B], [Spring(("bob", "tip"), 1.0), Gravity()])
    with pytest.raises(ValueError, match=r"Scene.without: there is no effect 'gravty'. Did you mean gravity\? There"):
        scene.without("gravty")
    with pytest.raises(ValueError, match=r"Scene.only: there is no effect 'spring'. Did you mean springs"):
        scene.only("spring")
    with pytest.raises(ValueError, match=r"Scene.replace: there is no body or effect 'bop'. Did you mean bob"):
        scene.replace("bop", mass=1.0)
    with pytest.raises(ValueError, match=r"Scene.replace: springs: there is no argument 'stifness'"):
        scene.replace("springs", stifness=1.0)
    with pytest.raises(Refused, match=r"Scene.replace: hub: there is no argument 'moments'"):
        Scene([RigidBody("hub", 1.0, Ball(0.1), [0, 0, 0])]).replace("hub", moments=[1.0, 1.0, 1.0])
    assert isinstance(scene.problem(), Problem)


def test_energy_that_is_not_smooth_at_the_start():
    def root(q, params):
        return (q[0][0] ** 2) ** 0.25

    with pytest.raises(ValueError, match=r"root: its energy between bob has no finite derivatives at the start"):
        Scene([A], [Potential(root, "bob")])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda x: Body("a", x, [1.0]), "Body a: mass has dtype float32; give float64"),
        (lambda x: Body("a", 1.0, x[None]), "Body a: position has dtype float32"),
        (lambda x: Scene([A, B], [Spring(("bob", "tip"), x)]), "springs: stiffness has dtype float32"),
        (lambda x: Scene([A, B], [Spring(("bob", "tip"), [x])]), "springs: stiffness has dtype float32"),
        (lambda x: Scene([A, B], [Anchor("tip", [x, 0.0])]), "anchors: point has dtype float32"),
        (lambda x: Scene([A], [Potential(height, "bob", {"k": x})]), r"height: params\['k'\] has dtype float32"),
        (lambda x: Scene([B], [Guide("tip", still, params={"k": x})]), r"guides: params\['k'\] has dtype float32"),
        (lambda x: Scene([A, B], [Coulomb({"bob": x, "tip": 1.0}, 1.0)]), r"coulomb: charges\['bob'\] has dtype"),
    ],
)
def test_numbers_made_before_64_bit_mode(make, message):
    with pytest.raises(ValueError, match=message):
        make(jnp.asarray(1.0, dtype=jnp.float32))


def test_scenes_made_before_64_bit_mode():
    """Bodies of plain numbers are of float64 all the same; a scene, which computes with them, is refused."""
    jax.config.update("jax_enable_x64", False)
    try:
        body = Body("a", 0.1, [0.1, 0.2])
        with pytest.raises(ValueError, match="vmri_jax needs 64-bit floats"):
            Scene([body])
    finally:
        jax.config.update("jax_enable_x64", True)
    assert (body.position.dtype, float(body.mass)) == (np.float64, 0.1)
    assert Scene([body], [Gravity(0.1)]).state().q_s.dtype == np.float64


def test_numbers_that_are_none():
    with pytest.raises(TypeError, match="springs: stiffness is 'stiff'; give real numbers"):
        Scene([A, B], [Spring(("bob", "tip"), "stiff")])
    with pytest.raises(TypeError, match="plane_contact: normal is 'up'; give real numbers"):
        Scene([A, B], [PlaneContact(point=[0.0, 0.0], normal="up", stiffness=1.0, smoothing=0.1)])
    with pytest.raises(TypeError, match="Body a: mass is 'heavy'; give real numbers"):
        Body("a", "heavy", [1.0])
    with pytest.raises(ValueError, match="springs: between is None; give 2 names of bodies"):
        Scene([A, B], [Spring(None, 1.0)])


def edge(q, v, params):
    """A skate: no velocity across its blade."""
    return v[0][0] * jnp.sin(q[0][2]) - v[0][1] * jnp.cos(q[0][2])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Constraint(edge, "bob"), "edge.*called with .q, params.*velocities .*out of scope.* Force.function"),
        (lambda: Constraint(edge, "bob", timed=True), "called with .t, q, params.*Give it all of these arguments"),
        (lambda: Potential(edge, "bob"), "called with .q, params.*depend on time are out of scope"),
        (lambda: Force(edge, "bob"), r"called with \(t, q, v, params\)\. Give it all of these arguments"),
        (lambda: Drive("bob", lambda t: 0.0), r"drive: history is .*called with \(t, params\)"),
        (lambda: Guide("bob", 3.0), r"guides: path is 3.0; give a function of \(t, params\)"),
    ],
)
def test_functions_of_other_arguments(make, message):
    with pytest.raises(TypeError, match=message):
        make()


@pytest.mark.parametrize(
    ("effect", "message"),
    [
        (Potential(lambda q, params: q[0] ** 2, "bob", name="pull"), r"pull: function returns shape \(2,\).* a scalar"),
        (Kinetic(lambda q, v, params: v[0], "bob", name="lift"), r"lift: function returns shape \(2,\).* a scalar"),
        (Constraint(lambda q, params: None, "bob", name="rail"), r"rail: function returns NoneType.*vector \(k,\)"),
        (Force(lambda t, q, v, params: -v[0], "bob", name="drag"), r"drag: .* shape \(2,\);.*\(force,\) of a single"),
        (Force(lambda t, q, v, params: (v[0][:1],), "bob", name="drag"), r"a force for each body, of shapes \(2,\)"),
        (Potential(lambda q, params: q[0][2], "bob", name="weight"), "weight: function takes an entry that is not"),
        (Drive("bob", lambda t, params: jnp.sin(t)), r"drive: history returns shape \(\); bob has dimension 2"),
    ],
)
def test_functions_that_return_something_else(effect, message):
    with pytest.raises(ValueError, match=message):
        Scene([A], [effect])


def test_functions_of_classes_are_named_where_they_return_wrong_values():
    """A force that is no tuple has the right number of rows between two bodies in the plane, and would be taken apart
    by coordinates."""

    class Tether(Effect):
        pair: Any = names(2)
        kind = "force"

        @staticmethod
        def function(t, q, v, params):
            return v[1] - v[0]

    class Attraction(Effect):
        pairs: Any = names(2)
        kind = "potential"

        @staticmethod
        def function(q, params):
            return jnp.sum((q[0] - q[1]) ** 2, axis=-1)

    class Rail(Effect):
        body: Any = names()
        kind = "constraint"

        @staticmethod
        def function(q, params):
            return q[0][..., 1] - 3.0

    bodies = [Body(name, 1.0, [float(x), 0.0]) for x, name in enumerate("abc")]
    with pytest.raises(ValueError, match=r"tether: function returns shape \(2,\); it must return a tuple with a force"):
        Scene(bodies, [Tether(("a", "b"))])
    with pytest.raises(ValueError, match=r"attraction: function returns shape \(2,\); .* the sum over all elements"):
        Scene(bodies, [Attraction([("a", "b"), ("b", "c")])])
    with pytest.raises(ValueError, match=r"Scene: the positions at the start violate rail a by 3"):
        Scene(bodies, [Rail("a")])
    with pytest.raises(ValueError, match=r"springs: between is \(0, 1\); give 2 names of bodies"):
        Scene(bodies, [Spring((0, 1), 5.0)])
    with pytest.raises(TypeError, match=r"coulomb: charges is list; give a dictionary of charges"):
        Scene(bodies, [Coulomb([1.0, 2.0])])

"""Sorting by frequencies of kinetic effects, and the reasons that are given."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vmri_jax import fully_implicit
from vmri_jax import scene as sc
from vmri_jax.scene.rates import measure


def paces(scene) -> dict:
    return {name: pace.value for name, pace in scene.sorting.paces.items()}


def frequency(scene, name) -> np.ndarray:
    """Of the elements of an effect."""
    effects = [effect for effect in scene.bound if effect.kind in ("potential", "kinetic")]
    return measure(scene.by_name, effects)[name].frequency


IONS = sc.Scene(
    [
        sc.Body("heavy", 20.0, [1.2, 0.0, 0.6], [0.0, -0.3, 0.0]),
        sc.Body("light", 1.0, [0.5, 0.8, 0.4], [4.0, 0.0, 0.5]),
        sc.Body("neutral", 1.0, [-0.5, -0.8, -0.8]),
    ],
    [sc.MagneticField([0.0, 57.0, 76.0], [-2.0, 1.0], ["heavy", "light"])],
)


def test_charges_that_gyrate_fast_are_fast():
    assert frequency(IONS, "magnetic_field") == pytest.approx([2.0 * 95.0 / 20.0, 95.0], rel=1e-12)
    assert paces(IONS) == {"heavy": "slow", "light": "fast", "neutral": "slow"}
    assert IONS.sorting.paces["light"].reason == "touched by magnetic_field, 95 rad/s, above 30"
    why = {row.name: row.why for row in IONS.explain(fully_implicit(2), measure=False).rows}
    assert why["light"] == "fast: touched by magnetic_field, 95 rad/s, above 30"
    assert paces(IONS.replace("magnetic_field", charge=[-20.0, 1.0])) == dict.fromkeys(IONS.by_name, "slow")
    flat = [sc.Body(name, m, [1.0, i]) for i, (name, m) in enumerate({"a": 1.0, "b": 2.0, "c": 40.0}.items())]
    assert paces(sc.Scene(flat, [sc.MagneticField(-8.0, 1.0)])) == {"a": "fast", "b": "fast", "c": "slow"}


def test_a_contact_acts_on_the_mass_of_a_small_body_and_not_on_its_inertia():
    ball = sc.RigidBody("ball", 2.0, (1e-4, 1e-4, 1e-4), [0.0, 0.0, 1.0])
    scene = sc.Scene(
        [ball], [sc.PlaneContact(point=[0, 0, 0], normal=[0, 0, 1], stiffness=800.0, smoothing=0.01), sc.Gravity()]
    )
    assert frequency(scene, "plane_contact") == pytest.approx(np.sqrt(800.0 / 2.0))


@pytest.mark.parametrize("far", [1.0, 100.0])
def test_angular_accelerations_count_without_the_size_of_the_scene(far):
    """A falling potential of the turn makes a wheel turn with T / J = 30 rad/s^2."""
    wheel = sc.RigidBody("wheel", 1.0, (0.1, 0.1, 0.2), [0.0, 0.0, 0.0])

    def turn(q, params):
        return -6.0 * q[0][4]  # the x axis leans towards y, at the rate of the turn about z

    scene = sc.Scene([wheel, sc.Body("stone", 1.0, [far, 0.0, 0.0])], [sc.Potential(turn, "wheel"), sc.Gravity()])
    effects = [effect for effect in scene.bound if effect.kind == "potential"]
    rates = measure(scene.by_name, effects)
    assert rates["turn"].rate == pytest.approx(np.sqrt(30.0))
    assert rates["gravity"].rate.max() == pytest.approx(np.sqrt(9.81 / far))


def test_gyration_and_stiffness_share_the_border():
    """A spring of 10 rad/s is stiff beside gravity alone; beside a gyration of 1000 rad/s it is not."""
    bodies = [sc.Body("ion", 1.0, [0.0, 0.0]), sc.Body("a", 1.0, [5.0, 0.0]), sc.Body("b", 1.0, [6.0, 0.0])]
    scene = sc.Scene(bodies, [sc.Gravity(), sc.Spring(("a", "b"), 50.0), sc.MagneticField(1000.0, 1.0, "ion")])
    assert paces(scene) == {"ion": "fast", "a": "slow", "b": "slow"}
    assert paces(scene.without("magnetic_field")) == {"ion": "slow", "a": "fast", "b": "fast"}


def test_the_reason_of_a_slow_body_names_a_stiff_spring_that_is_part_of_v():
    """A spring of 300 rad/s to a body with the pace "slow" leaves the other body slow; its reason does not say that
    none touches it."""
    bodies = [sc.Body("a", 1.0, [0.0, 0.0], pace="slow"), sc.Body("b", 1.0, [1.0, 0.0])]
    scene = sc.Scene(bodies, [sc.Gravity(), sc.Spring(("a", "b"), 4.5e4)])
    pace = scene.sorting.paces["b"]
    assert pace.value == "slow"
    assert pace.reason.startswith("springs, 300 rad/s, above ")
    assert pace.reason.endswith(", is part of V: it also touches a, whose pace is slow")


def test_the_reason_of_a_slow_body_names_a_stiff_spring_between_bodies_that_it_carries():
    box = sc.Box((0.2, 0.2, 0.2))
    bodies = [
        sc.RigidBody("hub", 100.0, box, [0.0, 0.0, 0.0]),
        *(sc.RigidBody(b, 1.0, box, [x, 0.0, 0.0]) for b, x in SIDES.items()),
    ]
    hinges = [
        sc.Revolute(("hub", b), axis=[0.0, 0.0, 1.0], at=[x / 2, 0.0, 0.0], name=f"to {b}") for b, x in SIDES.items()
    ]
    scene = sc.Scene(bodies, [sc.Gravity(), *hinges, sc.Spring(("left", "right"), 4.5e4)], coordinates="joint")
    assert paces(scene) == {"hub": "slow", "left": "fast", "right": "fast"}
    assert re.fullmatch(
        r"springs, 3\d\d rad/s, above [\d.]+, acts between bodies that it carries", scene.sorting.paces["hub"].reason
    )


SIDES = {"left": -1.0, "right": 1.0}


def test_declared_rate_of_a_kinetic_effect_wins():
    fast = IONS.replace("magnetic_field", rate="fast")
    assert paces(fast) == {"heavy": "fast", "light": "fast", "neutral": "slow"}
    assert fast.sorting.paces["heavy"].reason == "touched by magnetic_field, declared fast"
    assert set(paces(IONS.replace("magnetic_field", rate="slow")).values()) == {"slow"}


def test_given_paces_win():
    assert paces(IONS.replace("light", pace="slow")) == dict.fromkeys(IONS.by_name, "slow")


def coupled(q, v, params):
    """All bodies at once: ``L = w (x_a v_b - x_b v_a)`` and a total time derivative, which changes no motion."""
    (a, b), (v_a, v_b) = q, v
    gauge = jax.jvp(lambda a, b: params["gauge"] * jnp.sum(jnp.sin(a) * b**3), (a, b), (v_a, v_b))[1]
    return params["w"] * jnp.sum(a * v_b - b * v_a) + gauge


def test_custom_kinetic_effects():
    """M^-1 (A^T - A) has eigenvalues +- 2 i w / sqrt(m_a m_b); gauge terms do not count."""
    bodies = [
        sc.Body("a", 4.0, [1.0], [2.0]),
        sc.Body("b", 1.0, [3.0], [-1.0]),
        sc.Body("c", 1.0, [9.0]),
        sc.Body("d", 1.0, [8.0]),
    ]
    effects = [sc.Kinetic(coupled, ("a", "b"), {"w": 30.0, "gauge": 500.0}), sc.Spring(("c", "d"), 1.0)]
    scene = sc.Scene(bodies, effects)
    assert frequency(scene, "coupled") == pytest.approx([30.0], rel=1e-9)
    assert paces(scene) == {"a": "fast", "b": "fast", "c": "slow", "d": "slow"}
    assert paces(scene.replace("a", pace="slow"))["b"] == "fast"  # it is on the micro grid whatever a is


def gradient_field(q, v, params):
    """``A = (0, B' x^2 / 2)``, hence ``B = B' x``."""
    (q,), (v,) = q, v
    return params["gradient"] / 2 * v[1] * q[0] ** 2


def test_velocity_dependent_forces_have_stiffness():
    """Where the field is zero and v_y = u there is no gyration, but ``m x'' = Q u B' x``."""
    scene = sc.Scene(
        [sc.Body("ion", 2.0, [0.0, 0.0], [0.0, -9.0])], [sc.Kinetic(gradient_field, "ion", {"gradient": 8.0})]
    )
    assert frequency(scene, "gradient_field") == pytest.approx([np.sqrt(9.0 * 8.0 / 2.0)], rel=1e-12)


def added_mass(q, v, params):
    return params["mass"] / 2 * jnp.sum((v[0] - v[1]) ** 2)


def test_kinetic_effects_are_part_of_the_mass():
    """An added mass m on the relative velocity of a spring's ends: ``w^2 = k / (1/2 + m)``."""
    bodies = [sc.Body("a", 1.0, [0.0]), sc.Body("b", 1.0, [1.0])]
    scene = sc.Scene(bodies, [sc.Spring(("a", "b"), 56.0), sc.Kinetic(added_mass, ("b", "a"), {"mass": 3.0})])
    assert frequency(scene, "springs") == pytest.approx([4.0], rel=1e-12)
    assert frequency(scene, "added_mass") == [0.0]
    with pytest.raises(ValueError, match=r"springs: the kinetic energy of a, b is not positive at the start"):
        scene.replace("added_mass", params={"mass": -3.0})


def norm_of(q, v, params):
    return params["f"] * jnp.linalg.norm(v[0])


def test_kinetic_effects_that_are_not_smooth():
    with pytest.raises(ValueError, match="norm_of: its energy between neutral has no finite derivatives at the start"):
        sc.Scene(IONS.bodies, [sc.Kinetic(norm_of, "neutral", {"f": 1.0})])


CHAIN = [
    sc.Body(name, 1.0, [float(i), 0.0], pace="slow" if name in "abcde" else "fast") for i, name in enumerate("abcdefgh")
]


def reasons(*effects) -> dict:
    return {(p.effect.name, p.home): p.reason for p in sc.Scene(CHAIN, effects).sorting.placed}


def test_all_reasons_are_given():
    found = reasons(
        sc.Spring([("a", "f"), ("f", "g"), ("a", "g"), ("g", "h"), ("f", "h")], [1.0, 1e4, 1.0, 1e4, 1.0]),
        sc.Gravity(name="weight"),
        sc.RigidLink([("a", "b"), ("b", "c"), ("e", "f")]),
    )
    soft = "between fast bodies but soft, below 14.1 rad/s"
    assert found == {
        ("springs", "slow_potential"): f"touches a, which is slow (2); {soft} (1)",
        ("springs", "fast_potential"): "between fast bodies and stiff, above 14.1 rad/s",
        ("weight", "slow_potential"): f"touches a, b, c and 2 more, which are slow (5); {soft} (3)",
        ("links", "slow_constraint"): "between slow bodies",
        ("links", "constraint"): "touches a fast body",
    }


def well(q, params):
    return params["k"] / 2 * sum(jnp.sum(x**2) for x in q)


def test_a_single_element_has_one_reason():
    found = reasons(sc.Potential(well, ("a", "b", "f"), {"k": 1.0}), sc.Coulomb({"g": 1.0, "h": 1.0}, 1.0, rate="slow"))
    assert found["well", "slow_potential"] == "touches a, b, which are slow"
    assert found["coulomb", "slow_potential"] == "as given"


def test_a_stiff_spring_is_fast_however_slow_a_declared_fast_one_is():
    """A spring of 10 rad/s that is declared fast, beside one of 1e4 rad/s, more than a thousand times as fast."""
    bodies = [
        sc.Body(name, 1.0, place)
        for name, place in zip("abcd", ([0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]), strict=True)
    ]
    springs = [sc.Spring(("a", "b"), 50.0, rate="fast", name="soft"), sc.Spring(("c", "d"), 6e7, name="stiff")]
    assert set(paces(sc.Scene(bodies, [sc.Gravity(), *springs])).values()) == {"fast"}

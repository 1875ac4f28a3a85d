"""Effects of one kind on one grid are one term of the system; their parameters, rows and names stay those of each
effect."""

from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vmri_jax import scene as sc
from vmri_jax.mechanics.surroundings import innermost
from vmri_jax.scene import functions
from vmri_jax.scene.declare import names, positive
from vmri_jax.scene.effect import Effect

N = 4
BARS = [
    sc.RigidBody(f"bar {i}", 1.0 + i, sc.Box((0.1, 0.2, 1.0)), [0, 0, -0.5 - i], pace="slow" if i < 2 else "fast")
    for i in range(N)
]
PAIRS = [("ground" if i == 0 else f"bar {i - 1}", f"bar {i}") for i in range(N)]
POINTS = [[0.0, 0.0, -float(i)] for i in range(N)]
SIDE = [0.0, 1.0, 0.0]


def well(q, params):
    """A potential of the user takes one element."""
    return jnp.sum(q[0] ** 2)


def one_by_one() -> sc.Scene:
    """A hanging chain in which every effect has several of its kind: of one element, of several, on the ground, in
    bodies, and with elements on both grids."""
    hinges = [
        sc.Revolute(pair, point, SIDE, name=f"hinge {i}")
        for i, (pair, point) in enumerate(zip(PAIRS, POINTS, strict=True))
    ]
    tips = [(f"bar {i}", [0.0, 0.1 * i, 0.2]) for i in range(N)]
    balls = [sc.Body(f"ball {i}", 1.0 + i, [2.0, i, 1.0], pace="slow") for i in range(3)]
    return sc.Scene(
        [*BARS, *balls],
        [
            sc.Gravity(),
            *hinges,
            *(sc.JointSpring(f"hinge {i}", 1.0 + i, 0.1 * i, name=f"coil {i}") for i in range(N)),
            sc.Spring([(tips[0], tips[1]), (tips[1], tips[2])], [5.0, 6.0], 0.7, name="two springs", rate="slow"),
            sc.Spring((tips[2], tips[3]), 7.0, name="one spring", rate="slow"),
            sc.Spring((("ground", [0.0, 1.0, 0.0]), tips[0]), 8.0, 0.5, name="to the ground", rate="slow"),
            *(sc.LinearDamping(0.1 + i, f"bar {i}", name=f"damper {i}") for i in range(N)),
            sc.Dashpot([("bar 0", "bar 1"), ("bar 1", "bar 2")], 0.2, name="two dashpots"),
            sc.Dashpot(("bar 2", "bar 3"), 0.3, name="one dashpot"),
            sc.Anchor("ball 0", [2.0, 0.0, 2.0], name="first rod"),
            sc.RigidLink(("ball 0", "ball 1"), name="second rod"),
            sc.RigidLink(("ball 1", "ball 2"), name="third rod"),
            sc.Potential(well, "ball 0", name="well 0"),
            sc.Potential(well, "ball 1", name="well 1"),
        ],
        coordinates="directors",
    )


def values(scene: sc.Scene, system, params):
    """All functions of a system at random positions and velocities."""
    random = np.random.default_rng(0)
    q_s, q_f, v_s, v_f = (np.asarray(x) + 0.1 * random.normal(size=np.shape(x)) for x in scene.start)
    system = system.replace(params=params)
    potentials = system.slow_potential(q_s, q_f, params), *(f(q_s, q_f, params) for f in system.potentials.values())
    return potentials, system.constraints(0.0, q_s, q_f), system.forces(0.0, q_s, q_f, v_s, v_f)


def test_one_term_has_the_values_of_several(monkeypatch):
    scene = one_by_one()
    joined, params = scene.system(), scene.params
    # between points in bodies, and to the ground
    assert sum(term.function == sc.Spring.function for term in innermost(joined.slow_potential).terms) == 1
    monkeypatch.setattr(functions, "joined", lambda terms, in_order=False: tuple(terms))
    several = scene.system()
    energy, spring = (
        lambda params, system=system: sum(values(scene, system, params)[0]) for system in (joined, several)
    )
    for ours, theirs in zip(
        jax.tree.leaves((values(scene, joined, params), jax.jit(jax.grad(energy))(params))),
        jax.tree.leaves((values(scene, several, params), jax.jit(jax.grad(spring))(params))),
        strict=True,
    ):
        np.testing.assert_allclose(ours, theirs, rtol=1e-13, atol=1e-13)  # measured: 1e-15


def equations(scene: sc.Scene) -> int:
    """Number of lines of the traced constraints."""
    system, (q_s, q_f, *_) = scene.system(), scene.start
    return str(jax.make_jaxpr(lambda q: system.constraints(0.0, q, q_f))(q_s)).count("\n")


def test_six_hinges_cost_what_six_elements_of_one_hinge_cost(monkeypatch):
    bars = [sc.RigidBody(f"bar {i}", 1.0, sc.Box((0.1, 0.2, 1.0)), [0, 0, -0.5 - i], pace="slow") for i in range(6)]
    pairs, points = (
        [("ground", "bar 0"), *pairwise(bar.name for bar in bars)],
        [[0.0, 0.0, -float(i)] for i in range(6)],
    )
    hinges = [
        sc.Revolute(pair, x, SIDE, name=f"hinge {i}") for i, (pair, x) in enumerate(zip(pairs, points, strict=True))
    ]
    scene = sc.Scene(bars, hinges, coordinates="directors")
    alone = equations(sc.Scene(bars, [sc.Revolute(pairs, points, SIDE)], coordinates="directors"))
    assert equations(scene) < 1.2 * alone  # measured: 1.17; 16 equations join the numbers of the six effects
    assert [*scene.names.slow_constraint] == [*(f"rigid {bar.name}" for bar in bars), *(hinge.name for hinge in hinges)]
    monkeypatch.setattr(functions, "joined", lambda terms, in_order=False: tuple(terms))
    assert equations(scene) > 1.3 * alone  # measured: 1.47


def test_a_number_in_a_list_is_the_number_of_a_single_element():
    """Joined with others, an axis too many would make a table of all numbers with all elements."""
    bodies = [sc.Body("a", 1.0, [1.0, 0.0, 0.0]), sc.Body("b", 2.0, [0.0, 1.0, 0.0])]

    def energy(*stiffness):
        springs = [
            sc.SpringAnchor([name], [0.0, 0.0, 0.0], k, name=f"to {name}")
            for name, k in zip("ab", stiffness, strict=True)
        ]
        scene = sc.Scene(bodies, springs)
        return sum(scene.system().all_potentials(*scene.start[:2]).values())

    assert energy([4.0], [9.0]) == energy(4.0, [9.0]) == energy(4.0, 9.0) == (4.0 + 9.0) / 2


class Quartic(Effect):
    """A potential of one body, written for one element."""

    body: Any = names()
    k: Any = positive()

    kind = "potential"

    @staticmethod
    def function(q, params):
        return params["k"] * jnp.sum(q[0] ** 2) ** 2


def test_functions_of_the_user_are_not_joined():
    bodies = [sc.Body("a", 1.0, [1.0, 0.0, 0.0]), sc.Body("b", 2.0, [0.0, 2.0, 0.0])]
    scene = sc.Scene(bodies, [Quartic("a", 1.0, name="x"), Quartic("b", 3.0, name="y")])
    assert sum(scene.system().all_potentials(*scene.start[:2]).values()) == 1.0 * 1.0 + 3.0 * 16.0


def test_a_drive_acts_on_a_point_in_a_rigid_body():
    body = sc.RigidBody("R", 2.0, sc.Box((0.1, 0.2, 1.0)), [0.0, 0.0, 0.0])
    drive = sc.Drive(
        ("R", [0.0, 0.0, 0.5]), lambda t, params: params["size"] * jnp.array([1.0, 0.0, 0.0]), {"size": 3.0}
    )
    scene = sc.Scene([body], [drive], coordinates="directors")
    q_s, q_f, v_s, v_f = scene.start
    force = np.concatenate(scene.system().forces(0.0, q_s, q_f, v_s, v_f))
    np.testing.assert_allclose(force[:3], [3.0, 0.0, 0.0])
    np.testing.assert_allclose(force[9:12], [1.5, 0.0, 0.0])  # half the force on the third director
    with pytest.raises(ValueError, match="params"):
        sc.Scene([body], [sc.Drive("R", lambda t, params: jnp.ones(3), 2.0)])

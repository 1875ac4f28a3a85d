# pyright: reportOptionalCall=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
# pyright: reportOperatorIssue=false, reportOptionalOperand=false
"""Scenes: sorting, composition, structure that is compared by value, parameters, drawing, the ledger."""

import dataclasses
import json
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.scene.gallery_scenes import gallery_scene
from tests.scene.mechanics import mechanics, values
from tests.support import set_up
from vmri_jax import ConstantMass, System, compose, fully_explicit, fully_implicit, galerkin, initial_state
from vmri_jax import scene as sc
from vmri_jax.animation.drawing import Drawing

TSP = gallery_scene("triple_spherical_pendulum")


def homes(scene) -> dict:
    """Where each effect lives."""
    found: dict = {}
    for part in scene.sorting.placed:
        found.setdefault(part.effect.name, []).append((part.home, part.elements))
    return found


def paces(scene) -> dict:
    return {name: pace.value for name, pace in scene.sorting.paces.items()}


def test_pace_is_found_from_stiffness():
    assert paces(TSP) == {"bob": "slow", "hook": "fast", "load": "fast"}
    assert "springs, 100 rad/s" in TSP.sorting.paces["hook"].reason  # sqrt(k (1 / m_1 + 1 / m_2))
    assert homes(TSP) == {
        "gravity": [("slow_potential", (0, 1, 2))],
        "anchors": [("slow_constraint", (0,))],
        "links": [("constraint", (0,))],
        "springs": [("fast_potential", (0,))],
    }


def test_one_rate_is_enough_without_a_gap():
    scene = TSP.replace("springs", stiffness=1.0)
    assert set(paces(scene).values()) == {"slow"}
    assert "no gap" in scene.sorting.paces["load"].reason
    assert homes(scene)["links"] == [("slow_constraint", (0,))]


def test_one_effect_is_split_by_stiffness_and_pace():
    bodies = [sc.Body(name, 1.0, [float(i)], pace="slow" if name == "a" else "fast") for i, name in enumerate("abcd")]
    springs = sc.Spring([("a", "b"), ("d", "b"), ("b", "c"), ("c", "d")], [1e4, 1.0, 1e4, 1e4])
    scene = sc.Scene(bodies, [springs])
    assert homes(scene)["springs"] == [("slow_potential", (0, 1)), ("fast_potential", (2, 3))]
    potentials = jax.jit(System.all_potentials)(scene.system(), np.array([0.1]), np.array([1.3, 2.5, 2.9]))
    assert float(potentials["slow"]) == pytest.approx((1e4 * 0.2**2 + 0.4**2) / 2)
    assert float(potentials["fast"]) == pytest.approx((1e4 * 0.2**2 + 1e4 * 0.6**2) / 2)


def test_declared_rate_wins():
    scene = TSP.replace("springs", rate="slow")
    assert paces(scene)["load"] == "slow"
    fast = [dataclasses.replace(body, pace="fast") for body in TSP.bodies]
    assert homes(sc.Scene(fast, TSP.effects).replace("gravity", rate="fast"))["gravity"] == [
        ("fast_potential", (0, 1, 2))
    ]
    mixed = sc.Scene([dataclasses.replace(TSP.bodies[0], pace="slow"), *TSP.bodies[1:]], [sc.Gravity(rate="fast")])
    assert homes(mixed)["gravity"] == [("fast", (0,)), ("fast_potential", (1, 2))]


forces_of = jax.jit(System.forces)


SPRINGS = sc.Scene(
    [
        sc.Body("trolley", 50.0, [0.0, 5.0]),
        sc.Body("hook", 1.0, [0.0, 2.0], [1.0, 0.0]),
        sc.Body("load", 1.0, [0.5, 1.0]),
    ],
    [sc.Gravity(), sc.Spring(("trolley", "hook"), 20.0, name="rope"), sc.Spring(("hook", "load"), 5e3, 1.1)],
)


def test_same_structure_is_compiled_once():
    traces = []

    @jax.jit
    def look(system, state):
        traces.append(None)
        return state.t

    for scene in (
        SPRINGS,
        sc.Scene(SPRINGS.bodies, [dataclasses.replace(effect) for effect in SPRINGS.effects]),
        SPRINGS.replace("springs", stiffness=4000.0),
        SPRINGS.replace("trolley", mass=100.0),
        SPRINGS.without("gravity"),
        SPRINGS.without("gravity").replace("rope", stiffness=30.0),
    ):
        look(scene.system(), scene.state())
    assert len(traces) == 2  # with gravity and without
    for stiffness in (1.0, 2e6):  # even where the scene would sort differently
        params = SPRINGS.params | {"springs": SPRINGS.params["springs"] | {"stiffness": np.asarray(stiffness)}}
        look(SPRINGS.system().replace(params=params), SPRINGS.state())
    assert len(traces) == 2


def counting(counts, name):
    def energy(q, params):
        counts[name] += 1
        return params["k"] * jnp.sum(q[0] ** 2)

    return energy


def test_what_is_left_out_is_never_evaluated():
    counts = dict.fromkeys("abcd", 0)
    effects = [sc.Potential(counting(counts, name), "body", {"k": 1.0}, name=name) for name in counts]
    scene = sc.Scene([sc.Body("body", 1.0, [1.0, 0.0], pace="slow")], effects)
    without = scene.without("c")
    counts.update(dict.fromkeys(counts, 0))  # functions are tried once when a scene is made
    jax.eval_shape(without.system().all_potentials, *without.start[:2])
    assert counts["c"] == 0
    assert min(counts[name] for name in "abd") > 0
    assert [effect.name for effect in scene.only("d", "a").effects] == ["a", "d"]


def test_what_no_effect_calls_for_does_not_exist():
    system = sc.Scene([sc.Body("body", 1.0, [1.0, 0.0])]).system()
    assert isinstance(system.kinetic, ConstantMass)
    for name in ("slow_potential", "fast_potential", "constraint", "slow_constraint", "force"):
        assert getattr(system, name) is None
    assert sc.Scene([sc.Body("body", 1.0, [1.0, 0.0])], [sc.RayleighDamping(stiffness=0.1)]).system().force is None


def swing(q, params):
    return jnp.sum(q[0] ** 2) - params["length"] ** 2


def push(t, q, v, params):
    return -params["c"] * v[0], jnp.zeros_like(v[1])


def well(q, params):
    return params["k"] / 2 * sum(jnp.sum(x**2) for x in q)


def level(q, params):
    return q[1][1] - q[0][1]


def turn(q, v, params):
    return params["w"] * jnp.dot(q[0], v[1])


def test_custom_effects_are_a_function_and_one_line():
    bodies = [
        sc.Body("a", 1.0, [1.0, 0.0], pace="slow"),
        sc.Body("block", [1.0, 2.0, 3.0, 4.0], np.ones(4), pace="fast"),
    ]
    scene = sc.Scene(bodies, [sc.Constraint(swing, "a", {"length": 1.0}), sc.Force(push, ("a", "block"), {"c": 0.5})])
    system = scene.system()
    q_s, q_f, v = np.array([1.0, 1.0]), np.ones(4), np.array([1.0, 2.0])
    assert values(system, 0.0, q_s, q_f, v, q_f)[-1].tolist() == [1.0]
    forces = forces_of(system, 0.0, q_s, q_f, v, q_f)
    assert forces[0].tolist() == [-0.5, -1.0]
    assert forces[1].tolist() == [0.0] * 4
    assert np.array_equal(system.kinetic.fast, [1, 2, 3, 4])


def test_bodies_of_different_dimension_share_an_effect_on_single_ones():
    bodies = [
        sc.Body("a", 2.0, [0.0, 5.0], [1.0, 2.0]),
        sc.Body("b", 3.0, [7.0], [3.0]),
        sc.Body("c", 1.0, [1.0, 1.0], [1.0, 1.0]),
    ]
    scene = sc.Scene(bodies, [sc.Gravity(10.0), sc.LinearDamping([0.1, 0.2, 0.3])])
    assert mechanics(scene).potential == pytest.approx(10 * (2 * 5 + 3 * 7 + 1 * 1))
    assert np.allclose(forces_of(scene.system(), 0.0, *scene.start)[0], [-0.1, -0.2, -0.6, -0.3, -0.3])


def test_pairs_nonlinear_springs_and_dashpots_are_the_formulas():
    points = np.random.default_rng(0).normal(size=(2, 4, 2))
    charges = dict(zip("abcd", [1.0, -2.0, 3.0, 0.5], strict=True))
    bodies = [sc.Body(name, 1.0, q, v) for name, q, v in zip("abcd", *points, strict=True)]
    dashpots = sc.Dashpot([("a", "b"), ("d", "b")], [0.3, 0.7])
    scene = sc.Scene(bodies, [sc.Coulomb(charges, 2.0), sc.NonlinearSpring(("a", "c"), (3.0, 0.5, 2.0), 0.7), dashpots])
    expected = sum(
        2 * charges[a] * charges[b] / np.linalg.norm(points[0, i] - points[0, j])
        for i, a in enumerate("abcd")
        for j, b in enumerate("abcd")
        if i < j
    )
    e = np.linalg.norm(points[0, 2] - points[0, 0]) - 0.7
    expected += 3.0 * e**2 / 2 + 0.5 * e**3 / 3 + 2.0 * e**4 / 4
    assert mechanics(scene).potential == pytest.approx(expected)
    force = np.zeros((4, 2))
    for a, b, c in ((0, 1, 0.3), (3, 1, 0.7)):
        n = (points[0, b] - points[0, a]) / np.linalg.norm(points[0, b] - points[0, a])
        pull = -c * ((points[1, b] - points[1, a]) @ n) * n
        force[b] += pull
        force[a] -= pull
    assert np.allclose(forces_of(scene.system(), 0.0, *scene.start)[0], force.reshape(-1))


def test_rayleigh_damping_is_the_matrix():
    """alpha M v + beta K v with K the Hessian of the named potentials."""
    bodies = [sc.Body("a", 2.0, [0.0, 1.0], [1.0, 0.5]), sc.Body("b", 1.0, [1.0, 3.0], [0.0, -1.0])]
    springs, well = sc.Spring(("a", "b"), 7.0, 1.5), sc.SpringAnchor("a", [0.0, 0.0], 3.0)
    scene = sc.Scene(bodies, [springs, well, sc.RayleighDamping(0.1, 0.02, of="springs")])
    q, v, none = np.array([0.0, 1.0, 1.0, 3.0]), np.array([1.0, 0.5, 0.0, -1.0]), np.zeros(0)
    only = scene.only("springs").system()
    matrix = np.asarray(jax.jit(jax.hessian(lambda q: only.slow_potential(q, none, only.params)))(q))
    expected = -0.1 * np.array([2, 2, 1, 1]) * v - 0.02 * matrix @ v
    assert np.allclose(forces_of(scene.system(), 0.0, q, none, v, none)[0], expected)
    with pytest.raises(ValueError, match="rayleigh_damping: there is no potential 'springs'"):
        scene.without("springs")


def test_drawing_is_plain_data():
    scene = sc.Scene(
        [
            sc.Body("a", 1.0, [0.0, 1.0], pace="fast"),
            sc.Body("b", 1.0, [1.0, 1.0], pace="slow", radius=0.5),
            sc.Body("block", 1.0, np.ones(4)),
            sc.Body("modes", 1.0, np.ones(2), pace="fast", block=True),
        ],
        [
            sc.Gravity([1.0, -2.0], ["a", "b"]),
            sc.RigidLink(("a", "b")),
            sc.SpringAnchor("b", [0.0, 0.0], 3.0, 1.0),
            sc.SpringAnchor("modes", [0.0, 0.0], 1.0, name="well"),
            sc.PlaneContact(point=[0, 0], normal=[0, 2], stiffness=1e4, smoothing=0.01, radius=0.1, bodies="a"),
        ],
    )
    drawing = scene.drawing()
    assert json.loads(json.dumps(drawing)) == drawing
    Drawing.from_dict(drawing)
    axes = {body["name"]: body["coordinates"] for body in drawing["bodies"]}
    assert axes["a"] == [["f", 0], ["f", 1]]
    assert axes["b"] == [["s", 0], ["s", 1]]
    assert drawing["blocks"] == [
        {"name": "block", "coordinates": [["s", i] for i in range(2, 6)]},
        {"name": "modes", "coordinates": [["f", 2], ["f", 3]]},
    ]
    assert [body["radius"] for body in drawing["bodies"]] == [0.1, 0.5]
    assert drawing["up"] == [-1.0, 2.0]
    assert drawing["links"] == [["a", "b"]]
    assert drawing["anchors"] == [{"body": "b", "point": [0.0, 0.0], "kind": "spring"}]
    assert drawing["planes"] == [{"point": [0.0, 0.0], "normal": [0.0, 1.0]}]


def test_custom_effects_are_drawn_as_they_say():
    bodies = [sc.Body(name, 1.0, [float(i), 0.0], pace="fast") for i, name in enumerate("abc")]

    def drawing(**how):
        effects = [
            sc.Potential(well, ("a", "c", "b"), {"k": 1.0}, **how),
            sc.Constraint(level, ("a", "b"), drawn_as="link"),
            sc.Force(push, ("c", "a"), {"c": 0.5}, drawn_as="spring"),
            sc.Kinetic(turn, ("c", "b"), {"w": 1.0}, drawn_as="link"),
        ]
        return sc.Scene(bodies, effects).drawing()

    seen = drawing(drawn_as="spring")
    assert seen["springs"] == [["a", "c"], ["c", "b"], ["c", "a"]]
    assert seen["links"] == [["a", "b"], ["c", "b"]]
    Drawing.from_dict(seen)
    assert drawing()["springs"] == [["c", "a"]]


def test_ledger_counts_unknowns_by_the_formula():
    sam = gallery_scene("simple_atomic_model")
    ledger = sam.explain(fully_implicit(20), measure=False)
    assert ledger.unknowns == 307  # the number that the reference study reports
    rows = {row.name: row for row in ledger.rows}
    assert (rows["gravity"].grid, rows["gravity"].evaluations) == ("micro", 20)
    assert (rows["links"].multipliers, rows["anchors"].multipliers) == (60, 1)
    rows = {row.name: row for row in sam.explain(fully_explicit(20), measure=False).rows}
    assert (rows["gravity"].grid, rows["gravity"].evaluations) == ("macro", 1)
    assert rows["stiff"].evaluations == 20
    assert sam.explain(galerkin(5, 2), measure=False).unknowns == 2 * 6 + 2 * 1 + 5 * 2 * (12 + 3)
    assert sam.explain(compose(fully_explicit(4), "yoshida4"), measure=False).unknowns == 3 * (6 + 1 + 4 * 15)


def test_ledger_measures():
    """A sum over 45 pairs takes longer than one over 10 bodies."""
    bodies = [sc.Body(f"b{i}", 1.0, [1.0 * i, 0.1 * i**2, 0.0]) for i in range(10)]
    effects = [sc.Gravity(), sc.LennardJones(1.0, 0.5), sc.LinearDamping(0.1)]
    ledger = sc.Scene(bodies, effects).explain(fully_explicit(1))
    assert ledger.microseconds is not None
    times = {row.name: row.microseconds for row in ledger.rows if row.kind != "body"}
    assert set(times) == {"gravity", "lennard_jones", "damping"}
    assert all(0 < time < ledger.microseconds for time in times.values())
    assert times["lennard_jones"] > 3 * times["gravity"]
    assert ledger.table().row_count == 14
    assert ledger.reasons().row_count == 13


def test_kinetic_energy_is_a_function_only_with_a_magnetic_field():
    charge = [sc.Body("a", 2.0, [1.0, 0.0], [0.0, 1.0])]
    scene = sc.Scene(charge, [sc.MagneticField(3.0, 0.5)])
    assert not isinstance(scene.system().kinetic, ConstantMass)
    assert isinstance(scene.without("magnetic_field").system().kinetic, ConstantMass)
    state = initial_state(
        scene.system(), *(getattr(scene.problem(), name) for name in ("q_s", "q_f", "v_s", "v_f")), project=True
    )
    assert np.allclose(state.p_s, [0.0, 2.0 + 0.5 * 3.0 / 2])  # m v + Q A


def test_arguments_may_be_iterators():
    bodies = [sc.Body(name, 1.0, [float(i), 0.0]) for i, name in enumerate("abcd")]
    given = [
        sc.Spring(pairwise("abcd"), (k for k in (1.0, 2.0, 3.0))),
        sc.RigidLink([iter("ab")]),
        sc.LinearDamping(0.1, iter("ab")),
        sc.Coulomb(dict.fromkeys("abcd", 1.0), between=map(tuple, ["ac", "bd"])),
        sc.RayleighDamping(stiffness=0.1, of=iter(["springs"])),
        sc.Force(push, (name for name in "ab"), {"c": 0.5}),
    ]
    kept = [
        sc.Spring([("a", "b"), ("b", "c"), ("c", "d")], [1.0, 2.0, 3.0]),
        sc.RigidLink([("a", "b")]),
        sc.LinearDamping(0.1, ["a", "b"]),
        sc.Coulomb(dict.fromkeys("abcd", 1.0), between=[("a", "c"), ("b", "d")]),
        sc.RayleighDamping(stiffness=0.1, of=["springs"]),
        sc.Force(push, ("a", "b"), {"c": 0.5}),
    ]
    scene, expected = sc.Scene(bodies, iter(given)), sc.Scene(bodies, kept)
    assert homes(scene) == homes(expected)
    assert scene.drawing() == expected.drawing()
    assert jax.tree.all(jax.tree.map(np.array_equal, scene.replace("springs", rate="slow").params, expected.params))


def test_a_scene_without_fast_bodies_says_so():
    scene = sc.Scene([sc.Body("a", 1.0, [1.0, 0.0])], [sc.Gravity()])
    with pytest.warns(UserWarning, match=r"no body of the scene is fast.* Take num_micro=1"):
        set_up(scene, fully_implicit(10), macro_dt=0.1, num_steps=1)
    set_up(scene, fully_implicit(1), macro_dt=0.1, num_steps=1)

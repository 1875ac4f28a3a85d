"""Bodies as functions of the freedoms of joints: the same mechanics as by directors, with fewer unknowns."""

import json
from dataclasses import replace
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from benchmarks.body_motions import accelerations
from tests.scene.mechanics import assert_mechanics_as_by_directors, mechanics
from tests.scene.random_trees import random_scene
from vmri_jax import scene as sc
from vmri_jax.animation.drawing import Drawing
from vmri_jax.animation.motion import motion as motion_of
from vmri_jax.mechanics.names import Names
from vmri_jax.mechanics.projection import closed_masses
from vmri_jax.scene import trees

DRAWN = (0, 6, 11)
"""Seeds whose scenes have all kinds of joints between them, from the first body to the second and back."""
SEEDS = [*DRAWN, *(pytest.param(seed, marks=pytest.mark.full) for seed in range(1, 10) if seed not in DRAWN)]


@pytest.mark.parametrize("seed", SEEDS)
def test_random_trees_have_the_mechanics_of_directors(seed):
    """Their equations of motion are solved in `test_joint_rings`."""
    scene, _ = random_scene(seed)
    assert_mechanics_as_by_directors(scene)


@pytest.mark.parametrize("seed", DRAWN[:2])
def test_the_mass_matrix_of_trees_in_closed_form(seed):
    problem = random_scene(seed)[0].problem()
    random = np.random.default_rng(seed)
    q_s, q_f = (q + 0.3 * random.normal(size=q.shape) for q in (problem.q_s, problem.q_f))

    def kinetic(v):
        return problem.system.kinetic_energy(q_s, q_f, v[: q_s.size], v[q_s.size :])

    kinetic_terms = problem.system.of_kind("kinetic")
    masses, expected = jax.jit(
        lambda: (
            closed_masses(kinetic_terms, q_s, q_f, problem.system.params),
            jax.hessian(kinetic)(jnp.zeros(q_s.size + q_f.size)),
        )
    )()
    np.testing.assert_allclose(masses, expected, rtol=0, atol=1e-14 * np.abs(expected).max())


@pytest.mark.parametrize("seed", [7, 11])  # of joints behind joints
def test_the_derivative_of_the_kinetic_energy_of_trees(seed):
    """By positions, against differences: it contains the derivatives of twists,
    `vmri_jax.mechanics.kinematics.placed`."""
    problem = random_scene(seed)[0].problem()
    random, n_s = np.random.default_rng(seed), problem.q_s.size
    q = np.concatenate([problem.q_s, problem.q_f])
    q, v, along = q + 0.3 * random.normal(size=q.size), random.normal(size=q.size), random.normal(size=q.size)

    @jax.jit
    def slope(x):
        """The kinetic energy at q + x along, and its derivative by x."""

        def kinetic(x):
            at = q + x * along
            return problem.system.kinetic_energy(at[:n_s], at[n_s:], v[:n_s], v[n_s:])

        return kinetic(x), jax.grad(kinetic)(x)

    h = 1e-5
    difference = (float(slope(h)[0]) - float(slope(-h)[0])) / (2 * h)
    assert abs(difference) > 1e-2
    np.testing.assert_allclose(slope(0.0)[1], difference, rtol=1e-7)


SPIN = np.array([0.05, 0.02, 0.2])
DRIFT = np.array([0.1, 0.0, 0.0])


def satellite(coordinates: Any = "joint", stiffness=20.0, along=0.0, rate: Any = "auto"):
    """A hub that floats, slow, with a panel on a hinge, fast."""
    place = np.array([0.1, 0.9, 0.0])
    hub = sc.RigidBody("hub", 5.0, sc.Box((1, 1, 1)), [0, 0, 0], spin=SPIN, velocity=DRIFT, pace="slow")
    panel = sc.RigidBody(
        "panel", 1.0, sc.Box((0.4, 0.8, 0.03)), place, spin=SPIN, velocity=np.cross(SPIN, place) + DRIFT, pace="fast"
    )
    hinge = sc.Revolute(("hub", "panel"), at=np.array([0, 0.5, 0]) + along * np.array([0, 0.1, 0]), axis=[1, 0, 0.2])
    effects = [replace(hinge, name="hinge"), sc.JointSpring("hinge", stiffness, 0.3, rate=rate)]
    return sc.Scene([hub, panel], effects, coordinates=coordinates)


@pytest.fixture(scope="module")
def run():
    """A second of it, ten micro steps of 0.005 s each: one run for all claims about runs."""
    return vm.simulate(satellite(), vm.fully_implicit(10), macro_dt=0.05, num_steps=20)


def test_a_hinge_is_one_unknown_and_no_row():
    scene = satellite()
    assert [x.size for x in scene.start] == [12, 1, 12, 1]
    assert scene.system().num_constraints(*scene.start[:2]) == (0, 6)
    assert (scene.names.slow, scene.names.fast) == ({"hub": 12}, {"hinge": 1})
    rows = {row.name: row for row in scene.explain(vm.fully_implicit(10), measure=False).rows}
    assert (rows["panel"].unknowns, rows["panel"].grid) == (10, "micro")
    assert rows["joint_springs"].kind == "fast potential W"
    assert "hinge" not in rows


def test_a_floating_root_keeps_all_momenta(run):
    for name in ("hub", "panel"):
        assert run.position(name).shape == run.velocity(name).shape == run.momentum(name).shape == (21, 12)
    momentum = run.momentum("hub")[:, :3] + run.momentum("panel")[:, :3]
    turning, more = (sc.angular_momentum(run.position(name), run.momentum(name)) for name in ("hub", "panel"))
    turning = turning + more
    assert np.abs(momentum - momentum[0]).max() < 1e-13  # of 0.6
    assert np.abs(turning - turning[0]).max() < 1e-13  # of 0.4
    assert np.ptp(run.position("hinge")) > 0.5


def test_a_floating_tree_has_the_mechanics_of_directors(run):
    scene = satellite()
    assert_mechanics_as_by_directors(scene)
    np.testing.assert_allclose(scene.joint_motion(run, "hinge"), run.position("hinge")[:, 0], atol=1e-14)


def test_reaction_forces_are_those_of_the_rows(run):
    scene = satellite()
    forces = scene.by_directors(run).reaction_forces("hinge")["panel"]
    acceleration = accelerations(scene, run[5])["panel"][2]
    np.testing.assert_allclose(forces[5][:3], acceleration[:3], atol=1e-10)  # 1 kg, and nothing else pulls its centre
    with pytest.raises(ValueError, match="by_directors"):
        run.reaction_forces("hinge")


def test_reaction_forces_of_a_joint_with_a_rotor():
    """A rotor adds to the momenta of directors: ``M v`` of the body alone is the momentum of a slower motion, with
    other forces."""
    arm = sc.RigidBody("arm", 2.0, [0.2, 0.3, 0.4], [0.5, 0.0, 0.0])
    hinge = sc.Revolute(("ground", "arm"), at=[0.0, 0.0, 0.0], axis=[0.0, 0.0, 1.0], name="hinge")
    scene = sc.Scene([arm], [hinge, sc.RotorInertia("hinge", 3.0)], coordinates="joint").with_rates({"hinge": 2.0})
    run = vm.simulate(scene, vm.fully_implicit(1), macro_dt=0.1, num_steps=3)
    twin = scene.by_directors(run)
    np.testing.assert_allclose(twin.velocity("arm"), run.velocity("arm"), atol=1e-12)
    pull = np.linalg.norm(twin.reaction_forces("hinge")["arm"][:, :3], axis=1)
    np.testing.assert_allclose(pull, 2.0 * 0.5 * 2.0**2, rtol=1e-12)  # m r omega^2


def test_a_stored_run_is_drawn_as_it_moved(run, tmp_path):
    problem = satellite().problem()
    run.save(tmp_path / "run.npz", problem.drawing)
    loaded = vm.Trajectory.load(tmp_path / "run.npz")
    assert problem.names is not None
    drawing = Drawing.from_dict(json.loads(json.dumps(problem.drawing)))
    seen = motion_of(loaded, drawing)
    at = [body.name for body in drawing.bodies].index("panel")
    np.testing.assert_allclose(seen.points[:, at], run.position("panel")[:, :3], atol=1e-12)
    assert Names.from_dict(json.loads(json.dumps(problem.names.to_dict()))).kinematics == problem.names.kinematics
    with pytest.raises(ValueError, match="does not know its system"):
        loaded.position("panel")
    np.testing.assert_allclose(loaded.of(problem).position("panel"), run.position("panel"), atol=1e-14)


def test_joints_start_where_they_are_told():
    turned = satellite().with_joints({"hinge": (0.4, -2.0)})
    assert [x.tolist() for x in turned.start[1::2]] == [[0.4], [-2.0]]
    (q, v), axis = mechanics(turned).bodies["panel"], np.array([1, 0, 0.2]) / np.hypot(1, 0.2)
    spin = np.cross(q[3:].reshape(3, 3), v[3:].reshape(3, 3)).sum(axis=0) / 2
    np.testing.assert_allclose(spin, SPIN - 2.0 * axis, atol=1e-12)
    assert float(satellite().with_rates({"hinge": 1.5}).start[3][0]) == pytest.approx(1.5)
    kept = turned.with_rates({"hinge": 1.5}).start
    assert (float(kept[1][0]), float(kept[3][0])) == pytest.approx((0.4, 1.5))


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        ({"hing": 0.1}, "Did you mean hinge"),
        ({"hinge": {"slide": 0.1}}, "leaves turn free"),
        ({"hinge": [0.1, 0.2]}, r"shape \(2,\)"),
        ({"hinge": np.nan}, "finite"),
    ],
)
def test_starts_that_cannot_be_are_refused(joints, message):
    with pytest.raises(ValueError, match=message):
        satellite().with_joints(joints)


def test_starts_of_joints_need_joint_coordinates():
    with pytest.raises(ValueError, match='coordinates="joint"'):
        satellite("directors").with_joints({"hinge": 0.1})
    with pytest.raises(ValueError, match="coordinates is 'angles'"):
        satellite("angles")
    with pytest.raises(ValueError, match="closes a loop"):
        four_bar().with_joints({"pin 2": 0.1})


def test_velocities_that_joints_do_not_allow_are_refused():
    torn = satellite().replace("panel", velocity=[0.0, 0.0, 1.0])
    with pytest.raises(ValueError, match="nearest velocities that fit the joints"):
        torn.problem()
    assert replace(torn, project=True).problem().v_f.size == 1


def torque(t, params):
    """A torque that changes with time."""
    return params["size"] * jnp.cos(t)


def angle(t, params):
    """An angle that is given."""
    return params["size"] * jnp.sin(t)


def test_what_acts_in_a_joint_acts_on_its_coordinate():
    bodies = [
        sc.RigidBody("arm", 2.0, sc.Ball(0.3), [1, 0, 0], pace="slow"),
        sc.RigidBody("sleeve", 1.0, sc.Ball(0.2), [1, 0.5, 0], pace="fast"),
    ]
    effects = [
        sc.Gravity([0, 0, -1.0]),
        sc.Revolute(("ground", "arm"), at=[0, 0, 0], axis=[0, 1, 0], name="hinge"),
        sc.Cylindrical(("sleeve", "arm"), at=[1, 0.2, 0], axis=[0, 1, 0], name="guide"),
        sc.JointDrive("hinge", torque, {"size": 0.3}),
        sc.JointLimit("guide", -0.1, 0.1, stiffness=50.0, smoothing=0.01, of="slide"),
        sc.JointMotion("guide", angle, {"size": 0.5}, of="turn"),
        sc.Controlled("hinge", "torque"),
    ]
    scene = sc.Scene(bodies, effects, coordinates="joint").with_joints({"guide": {"slide": 0.12}})
    q_s, q_f, *_ = scene.start
    assert [q_s.tolist(), q_f.tolist()] == [[0.0], [0.0, 0.12]]
    system = scene.system()
    actuation: Any = scene.actuation
    acting = jax.jit(lambda q_f, u: (system.g(0.7, q_s, q_f), actuation(q_s, q_f, u, system.params)))
    g, push = acting(q_f + np.array([0.3, 0]), np.array([2.0]))
    np.testing.assert_allclose(g, 0.3 - 0.5 * np.sin(0.7), atol=1e-15)
    np.testing.assert_allclose(np.concatenate(push), [2.0, 0.0, 0.0], atol=1e-15)
    assert_mechanics_as_by_directors(scene, t=0.7)


def four_bar(coordinates: Any = "joint", second: Any = sc.Revolute):
    """A crank, a rod and a rocker between hinges, in a plane."""
    pins = np.array([[0, 0, 0], [0.3, 0.95, 0], [2, 1.5, 0], [2, 0, 0]])
    names, bodies, effects = ("ground", "crank", "rod", "rocker", "ground"), [], []
    for name, start, end in zip(names[1:], pins[:-1], pins[1:], strict=False):
        way = end - start
        shape = sc.Box((float(np.linalg.norm(way)), 0.1, 0.1))
        turn = [0, 0, np.arctan2(way[1], way[0])]
        bodies.append(sc.RigidBody(name, 1.0, shape, (start + end) / 2, rotation=turn, pace="slow"))
    for i, pin in enumerate(pins):
        joint = second if i == 1 else sc.Revolute
        effects.append(joint(names[i : i + 2], at=pin, axis=[0, 0, 1], name=f"pin {i}"))
    return sc.Scene(
        bodies, [sc.Gravity([0, -9.81, 0]), *effects], coordinates=coordinates, redundant="drop", project=True
    )


def test_a_loop_is_cut_at_one_joint():
    scene = four_bar()
    assert [x.size for x in scene.start[:2]] == [3, 0]
    assert len(scene.dropped) == 3
    assert scene.system().num_constraints(*scene.start[:2]) == (0, 2)
    cranked = scene.with_rates({"pin 0": 3.0})
    rates = dict(zip(scene.names.slow, cranked.start[2], strict=True))
    assert float(rates["pin 0"]) == pytest.approx(3.0)
    assert np.abs(rows_and_rates(scene.system(), *cranked.start)[1]).max() < 1e-12


@jax.jit
def rows_and_rates(system, q_s, q_f, v_s, v_f):
    """Values and rates of all constraints at t = 0."""
    return system.constraints(0.0, q_s, q_f), system.constraint_rates(0.0, q_s, q_f, v_s, v_f)


def test_deep_trees_keep_directors_where_the_scene_chooses(monkeypatch):
    """A chain of three bars that hangs on the ground, beside a single one."""
    monkeypatch.setattr(trees, "LONGEST", 2)
    names = ["ground", "first", "second", "third"]
    bars = [sc.RigidBody(name, 1.0, sc.Box((0.1, 0.1, 1)), [0, 0, -0.5 - i]) for i, name in enumerate(names[1:])]
    pins = [sc.Revolute(pair, [0, 0, -i], axis=[0, 1, 0], name=f"pin {i}") for i, pair in enumerate(pairwise(names))]
    alone = sc.RigidBody("alone", 1.0, sc.Box((0.1, 0.1, 1)), [2, 0, -0.5])
    pin = sc.Revolute(("ground", "alone"), [2, 0, 0], axis=[0, 1, 0], name="pin")
    scene = sc.Scene([*bars, alone], [*pins, pin], coordinates="auto")
    assert [branch.child for branch in scene.branches] == ["alone"]
    assert scene.start[0].size == 3 * 12 + 1
    monkeypatch.setattr(trees, "LONGEST", 3)
    assert sc.Scene([*bars, alone], [*pins, pin], coordinates="auto").start[0].size == 4


def test_joints_of_a_loop_follow_those_that_are_named():
    """Within reach, on the branch of the start and with their rates; beyond, and where all are named, by how much the
    loop is open."""
    scene = four_bar()
    moved = scene.with_joints({"pin 0": (-0.5, 1.0)})
    q, _, v, _ = moved.start
    assert (q[0], v[0]) == (-0.5, 1.0)
    assert np.abs(rows_and_rates(scene.system(), *moved.start)).max() < 1e-13
    assert np.abs(q[1:]).max() < 1.0  # the other branch, and whole turns, are further away
    with pytest.raises(ValueError, match=r"keeps pin 2 rod-rocker .*stays open by 0\.925\. It is kept up to pin 0 at"):
        scene.with_joints({"pin 0": 0.5, "pin 1": 0.0})
    with pytest.raises(ValueError, match=r"stays open by \d\.\d+\. It is kept up to pin 3 at 0\.24"):
        scene.with_joints({"pin 3": 0.4})


def test_of_a_loop_the_joint_with_the_fewest_rows_is_cut():
    assert {branch.joint.name for branch in four_bar().branches} == {"pin 0", "pin 1", "pin 3"}
    assert {branch.joint.name for branch in four_bar(second=sc.Cylindrical).branches} == {"pin 0", "pin 2", "pin 3"}

"""Whole turns of the angles of joints: effects that count them, loops, starts, and how they are read from runs."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import permutations
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.support import until_failure
from vmri_jax import scene as sc
from vmri_jax.scene import trees
from vmri_jax.scene.binding import bound
from vmri_jax.scene.effects.joint_base import REACH, OfFreedoms
from vmri_jax.scene.joint_coordinates import at_start
from vmri_jax.steppers.results import Result

Z = np.array([0.0, 0.0, 1.0])
ONE = vm.fully_implicit(1)


def torque(t, params):
    return 3.0 * jnp.ones_like(t)


def same(x, params):
    return x[0] - x[1]


EFFECTS: dict[str, tuple[Any, bool]] = {
    "spring": (lambda name: sc.JointSpring(name, 2.0, 0.3), True),
    "limit": (lambda name: sc.JointLimit(name, -0.5, 0.4, stiffness=50.0, smoothing=0.02), True),
    "gear": (lambda name: sc.Gear([name, "other"], [1.0, -2.0]), True),
    "coupling": (lambda name: sc.JointCoupling([name, "other"], same), True),
    "damper": (lambda name: sc.JointDamper(name, 0.7), False),
    "rotor": (lambda name: sc.RotorInertia(name, 1.5), False),
    "drive": (lambda name: sc.JointDrive(name, torque), False),
    "motion": (lambda name: sc.JointMotion(name, lambda t, params: 2.0 * t), False),
    "control": (lambda name: sc.Controlled(name, "torque"), False),
}
"""Every effect in a joint, and whether it counts whole turns of the angle."""


def test_every_effect_in_a_joint_is_here():
    classes = {type(make("hinge")) for make, _ in EFFECTS.values()}
    known = {of for of in all_subclasses(OfFreedoms) if of.__module__.startswith("vmri_jax") and of.default_name}
    assert known <= classes


def all_subclasses(of):
    return {of, *(each for child in of.__subclasses__() for each in all_subclasses(child))}


def wheels(*effects, coordinates: Any = "auto", spin=(0.0, 0.0)):
    """Two wheels of unit inertia on hinges."""
    bodies = [
        sc.RigidBody(name, 1.0, [1.0] * 3, [x, 0, 0], spin=rate * Z)
        for name, x, rate in zip(("wheel", "second"), (0.0, 3.0), spin, strict=True)
    ]
    hinges = [
        sc.Revolute(("ground", name), [x, 0, 0], Z, name=joint)
        for name, x, joint in (("wheel", 0.0, "hinge"), ("second", 3.0, "other"))
    ]
    return sc.Scene(bodies, [*hinges, *effects], coordinates=coordinates)


@jax.jit
def directors(angles):
    """q_s (24,) of both wheels at these angles, and dq_s/dangle (24, 2)."""

    def coordinates(angles):
        c, s = jnp.cos(angles), jnp.sin(angles)
        wheels = [jnp.stack([x, 0, 0, c[i], s[i], 0, -s[i], c[i], 0, 0, 0, 1]) for i, x in enumerate((0.0, 3.0))]
        return jnp.concatenate(wheels)

    return coordinates(angles), jax.jacfwd(coordinates)(angles)


@partial(jax.jit, static_argnums=0)
def seen(scenes, angles):
    """What the effects of each scene do to the angles."""
    return [effects_on(scene, angles) for scene in scenes]


def effects_on(scene, angles):
    """Forces of potentials, forces, controls, energy of rotors, rows of couplings."""
    q, motions = (angles, jnp.eye(2)) if scene.branches else directors(angles)
    v, none, system = motions @ jnp.array([0.8, 0.0]), jnp.zeros(0), scene.system()
    numbers = [system.kinetic_energy(q, none, v, none) if not system.has_constant_mass else v @ v / 4]
    if system.slow_potential is not None:
        numbers += [*(jax.grad(system.slow_potential)(q, none, system.params) @ motions)]
    if system.force is not None:
        numbers += [*(system.forces(0.3, q, none, v, none)[0] @ motions)]
    if scene.actuation is not None:
        numbers += [*(scene.actuation(q, none, jnp.array([2.0]), system.params)[0] @ motions)]
    rows = system.constraints(0.3, q, none)
    rows_of_angles = [
        i for name, rows in scene.names.rows.items() if name in ("gear", "coupling", "joint_motion") for i in rows
    ]
    return jnp.stack([*numbers, *(rows[i] for i in rows_of_angles)])


@pytest.mark.parametrize("name", EFFECTS)
def test_effects_know_turns_or_need_none(name):
    """In joint coordinates, and by directors within reach or without turns: the same; beyond reach NaN, which ends a
    run."""
    make, counts = EFFECTS[name]
    scenes = tuple(wheels(make("hinge"), coordinates=kind) for kind in ("auto", "directors"))
    assert [len(scene.branches) for scene in scenes] == [2, 0]

    def both(angle):
        return list(map(np.array, seen(scenes, np.array([angle, 0.2]))))

    for angle in (0.7, -2.5):
        here, there = both(angle)
        if name == "motion":  # the row of directors is the sine of the difference
            here[-1] = np.sin(here[-1])
        np.testing.assert_allclose(there, here, atol=1e-12)
    for angle in (0.7 + 2 * np.pi, 2.7, -3.0):
        here, there = both(angle)
        if counts:
            assert np.isfinite(here).all()
            assert np.isnan(there).any() == (abs(angle) < np.pi)  # an angle past the gap is an end of its run already
        else:
            here[-1] = np.sin(here[-1]) if name == "motion" else here[-1]
            np.testing.assert_allclose(there, here, atol=1e-12)


CRANK, COUPLER, ROCKER = 0.5, 2.0, 1.5
HINGES = ("hA", "hB", "hC", "hD")


def rod(name, start, end):
    way = end - start
    shape = sc.Box((float(np.linalg.norm(way)), 0.05, 0.05))
    return sc.RigidBody(name, 1.0, shape, (start + end) / 2, [0.0, 0.0, np.arctan2(way[1], way[0])])


def crank_rocker(*effects, order: Sequence[int] = range(4), names=HINGES, coordinates: Any = "auto"):
    """A four-bar linkage whose crank turns all the way round."""
    a, b, d = np.zeros(3), np.array([0.0, CRANK, 0.0]), np.array([2.0, 0.0, 0.0])
    way = d - b
    length = np.linalg.norm(way)
    along = (COUPLER**2 - ROCKER**2 + length**2) / 2 / length
    c = b + along * way / length + np.sqrt(COUPLER**2 - along**2) * np.array([-way[1], way[0], 0.0]) / length
    pairs = ("ground", "crank"), ("crank", "coupler"), ("coupler", "rocker"), ("ground", "rocker")
    joints = [sc.Revolute(pair, p, Z, name=name) for pair, p, name in zip(pairs, (a, b, c, d), names, strict=True)]
    bodies = [rod("crank", a, b), rod("coupler", b, c), rod("rocker", c, d)]
    listed = [joints[i] for i in order]
    return sc.Scene(bodies, [*listed, *effects], redundant="drop", coordinates=coordinates)


def cut(scene):
    """Names of the joints that close loops."""
    return set(HINGES) - {branch.joint.name for branch in scene.branches}


@pytest.mark.parametrize("name", [name for name in EFFECTS if name not in ("gear", "coupling")])
def test_a_joint_with_an_effect_is_not_cut_in_any_order(name):
    scene, make = crank_rocker(), EFFECTS[name][0]
    cuts = set()
    for hinge in HINGES:
        *joints, acting = bound([*scene.effects, make(hinge)], scene.by_name)
        for order in permutations(joints):
            branches = trees.grow(scene.by_name, [*order, acting])
            cuts.add((hinge, *(h for h in HINGES if h not in {branch.joint.name for branch in branches})))
    assert len(cuts) == 4  # one for each hinge, whatever the order
    assert all(hinge != closed for hinge, closed in cuts)


def test_turns_go_before_other_effects():
    """Where every joint has an effect, the joint with the drive alone is cut."""
    springs = [sc.JointSpring(h, 0.2, name=f"spring {h}") for h in ("hA", "hB", "hD")]
    assert cut(crank_rocker(*springs, sc.JointDrive("hC", torque))) == {"hC"}
    assert cut(crank_rocker(sc.JointSpring("hC", 0.2), order=(3, 1, 0, 2))) != {"hC"}


def test_a_spring_in_a_loop_counts_its_turns():
    """The angle of the crank at the end is that of DOP853 with one angle."""
    scene = crank_rocker(sc.JointSpring("hB", 0.2), order=(1, 2, 3, 0), coordinates="joint").with_rates({"hA": 12.0})
    run = vm.simulate(scene, ONE, macro_dt=0.002, t_end=3.0)
    assert np.abs(run.constraint_residual).max() < 1e-12
    assert scene.joint_motion(run, "hA")[-1] == pytest.approx(12.186, abs=1e-3)  # measured 12.18589
    angles = {hinge: scene.joint_motion(run, hinge) for hinge in HINGES}  # one of them without a coordinate
    np.testing.assert_allclose(angles["hA"] + angles["hB"] + angles["hC"], angles["hD"], atol=1e-9)


def test_starts_of_loops_count_the_turns_of_all_joints():
    scene = crank_rocker(coordinates="joint").with_joints({"hA": 7.0})
    (closed,) = cut(scene)
    x = dict(zip(scene.names.slow, np.asarray(scene.start[0]), strict=True))
    (joint,) = (e for e in scene.bound if e.name == closed and isinstance(e, sc.Revolute))
    x[closed] = at_start(scene.sorting, joint, 0, "turn")
    assert x["hA"] == 7.0
    assert x["hA"] + x["hB"] + x["hC"] == pytest.approx(x["hD"], abs=1e-9)
    assert max(abs(x["hB"]), abs(x["hC"])) > 5.0
    names = ("hA", "pin", "hC", "hD")  # equal joints are cut by name: here the one that turns with the crank
    sprung = crank_rocker(*(sc.JointSpring(hinge, 0.2, name=f"spring {hinge}") for hinge in names), names=names)
    with pytest.raises(ValueError, match=r"spring pin: the start is -[67].*angle of pin comes .*leave one of these"):
        sprung.with_joints({"hA": 7.0})


def test_gears_start_with_their_turns():
    geared = wheels(sc.Gear(["hinge", "other"], [1.0, -4.0])).with_joints({"hinge": 7.0})
    np.testing.assert_allclose(geared.start[0], [7.0, 1.75], atol=1e-12)


STEPS = {"macro_dt": 0.01, "num_steps": 500, "save": 5}


def sprung(stiffness):
    return sc.JointSpring("hinge", stiffness), sc.JointLimit("other", -4.15, 4.15, stiffness=500.0, smoothing=0.02)


def test_springs_and_limits_beyond_half_a_turn():
    """A spring of 2 N m/rad at 8 rad/s turns by 8 / sqrt(2) = 5.657 rad, a limit at 4.15 rad turns back at about 4.2
    rad."""
    effects = sprung(2.0)
    scene = wheels(*effects, spin=(8.0, 2.0))
    run = vm.simulate(scene, ONE, **STEPS)
    largest = [np.abs(scene.joint_motion(run, name)).max() for name in ("hinge", "other")]
    assert largest == pytest.approx([5.657, 4.2], abs=0.04)
    with pytest.raises(ValueError, match=r"joint_springs: the largest angle of the run is 5\.6.*directors"):
        scene.without("joint_limits").by_directors(run)
    with pytest.raises(ValueError, match=r'joint_limits: lower is -4.15; the angle of other.*coordinates="joint"'):
        wheels(*effects, coordinates="directors")
    with pytest.raises(ValueError, match=r"joint_springs: neutral is 7.0; the angle of hinge comes from directors"):
        wheels(sc.JointSpring("hinge", 2.0, 7.0), coordinates="directors")


def test_runs_by_directors():
    """A spring ends a run before half a turn.

    Where nothing counts them, turns are counted from node to node, here of a motion that is put in.
    """
    scene = wheels(sc.JointSpring("hinge", 2.0), coordinates="directors", spin=(8.0, 0.0))
    run = until_failure(scene, ONE, macro_dt=0.01, num_steps=100, solver=vm.Solver("masses"))
    assert Result(int(run.result)) == Result.NON_FINITE
    assert 'coordinates="joint"' in str(run.result)
    reached = run.position("wheel")[int(run.failed_at), 3:5]
    assert np.arctan2(*reached[::-1]) == pytest.approx(REACH, abs=0.1)
    angles = np.stack([np.linspace(0.0, 100.0, 101), np.zeros(101)], axis=1)
    free = wheels(coordinates="directors")
    q, motions = map(np.asarray, jax.vmap(directors)(angles))
    masses: Any = free.system().kinetic
    momenta = np.asarray(masses.slow) * (motions @ np.array([100.0, 0.0]))
    spinning = replace(run, states=replace(run.states, q_s=q, p_s=momenta))
    assert free.joint_motion(spinning, "hinge")[-1] == pytest.approx(100.0, abs=1e-12)
    with pytest.raises(ValueError, match=r"hinge may turn by half a turn or more .* nodes 0 and 1.*save="):
        free.joint_motion(spinning[::5], "hinge")


def test_turns_are_coordinates():
    """100 rad/s; a spring as soft as none makes the program that of the springs above."""
    scene = wheels(*sprung(1e-12), spin=(100.0, 0.0))
    for start in (0.0, 7.0):
        turned = scene.with_joints({"hinge": (start, 100.0)})
        angle = turned.joint_motion(vm.simulate(turned, ONE, **STEPS), "hinge")
        np.testing.assert_allclose(angle[[0, 50, 100]], start + np.array([0.0, 250.0, 500.0]), atol=1e-8)


def test_dense_loops_keep_the_angles_that_effects_need():
    assert [branch.joint.name for branch in crank_rocker(sc.JointSpring("hB", 0.2)).branches] == ["hB"]
    assert crank_rocker(sc.JointDrive("hB", torque)).branches == ()

"""The reference systems as scenes: functions and, bit for bit, trajectories of the hand-written ones."""

import dataclasses
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import jax
import numpy as np
import pytest

import vmri_jax
from tests.scene.gallery_scenes import gallery_scene
from vmri_jax import ConstantMass, simulate, systems
from vmri_jax.mechanics import arrays

NAMES = ("fermi_pasta_ulam", "triple_spherical_pendulum", "simple_atomic_model")
FPU, TSP, SAM = NAMES
CASES = [
    (FPU, "fully_explicit"),
    (TSP, "fully_implicit"),
    (SAM, "fully_explicit"),
    (SAM, "fully_implicit"),
    (FPU, "fully_implicit"),
    (TSP, "explicit_slow"),
    (TSP, "fully_explicit"),
    (SAM, "explicit_slow"),
]


def assert_trajectories_are_equal(name, scheme):
    jax.config.update("jax_enable_x64", True)
    arrays.OLDER_EMITTERS = {}
    scene, problem, scheme = gallery_scene(name), getattr(systems, name)(), getattr(vmri_jax, scheme)(5)
    step = {"macro_dt": 0.01, "num_steps": 200}
    run = simulate(scene.system(), scheme, scene.state(), **step)
    expected = simulate(problem.system, scheme, problem.state(), **step)
    for field in ("t", "q_s", "q_f", "p_s", "p_f"):
        assert np.array_equal(getattr(run, field), getattr(expected, field)), field
    assert np.allclose(run.energy, expected.energy, rtol=1e-13, atol=0)  # of other sums: equal to round-off


@pytest.mark.full  # forces, masses and rows are compared below, to round-off
@pytest.mark.parametrize(("name", "scheme"), CASES)
def test_trajectories_are_equal(name, scheme, monkeypatch):
    """In a process of its own: to the last bit only as XLA compiles by default, not with the flags of these tests and
    the options of runs."""
    monkeypatch.setenv("XLA_FLAGS", "")
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
        process.submit(assert_trajectories_are_equal, name, scheme).result()


@pytest.mark.parametrize("name", NAMES)
def test_functions_are_those_of_the_system(name):
    scene, problem = gallery_scene(name), getattr(systems, name)()
    system, hand = scene.system(), problem.system
    for field in dataclasses.fields(system):
        assert (getattr(system, field.name) is None) == (getattr(hand, field.name) is None), field.name
    assert isinstance(system.kinetic, ConstantMass)
    assert system.fast_potential is not None
    assert all(map(np.array_equal, jax.tree.leaves(system.kinetic), jax.tree.leaves(hand.kinetic)))
    assert system.num_constraints(problem.q_s, problem.q_f) == hand.num_constraints(problem.q_s, problem.q_f)
    random = np.random.default_rng(0)
    q_s, q_f = (q + 0.1 * random.normal(size=q.shape) for q in (problem.q_s, problem.q_f))
    ours, theirs = (forces_and_rows(each, q_s, q_f) for each in (system, hand))
    for mine, expected in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(mine, expected, rtol=1e-13, atol=1e-14 * np.abs(expected).max(initial=0.0))


@jax.jit
def forces_and_rows(system, q_s, q_f):
    """Gradients of all potentials, values and Jacobian of all rows: a step needs nothing else of a system."""

    def potential(q_s, q_f):
        return sum(system.all_potentials(q_s, q_f).values())

    def rows(q_s, q_f):
        return system.constraints(0.0, q_s, q_f)

    arguments = q_s, q_f
    return *jax.grad(potential, (0, 1))(*arguments), rows(*arguments), jax.jacrev(rows, (0, 1))(*arguments)

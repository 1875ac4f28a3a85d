"""The reference systems as scenes: the trajectories of the hand-written ones, bit for bit."""

import dataclasses

import jax
import numpy as np
import pytest

from tests.scene.gallery_scenes import gallery_scene
from vmri_jax import ConstantMass, explicit_slow, fully_explicit, fully_implicit, simulate, systems

NAMES = ("fermi_pasta_ulam", "triple_spherical_pendulum", "simple_atomic_model")
FPU, TSP, SAM = NAMES
CASES = [(FPU, fully_explicit(5)), (TSP, fully_implicit(5)), (SAM, fully_explicit(5))]
MORE = [
    (SAM, fully_implicit(5)),
    (FPU, fully_implicit(5)),
    (TSP, explicit_slow(5)),
    (TSP, fully_explicit(5)),
    (SAM, explicit_slow(5)),
]


@pytest.mark.parametrize(("name", "scheme"), [*CASES, *(pytest.param(*case, marks=pytest.mark.full) for case in MORE)])
def test_trajectories_are_equal(name, scheme):
    scene, problem = gallery_scene(name), getattr(systems, name)()
    step = {"macro_dt": 0.01, "num_steps": 200}
    run = simulate(scene.system(), scheme, scene.state(), **step)
    expected = simulate(problem.system, scheme, problem.state(), **step)
    for field in ("t", "q_s", "q_f", "p_s", "p_f"):
        assert np.array_equal(getattr(run, field), getattr(expected, field)), field
    assert np.allclose(run.energy, expected.energy, rtol=1e-13, atol=0)  # of other sums: equal to round-off


@pytest.mark.parametrize("name", NAMES)
def test_structure_is_that_of_the_system(name):
    scene, problem = gallery_scene(name), getattr(systems, name)()
    system, hand = scene.system(), problem.system
    for field in dataclasses.fields(system):
        assert (getattr(system, field.name) is None) == (getattr(hand, field.name) is None), field.name
    assert isinstance(system.kinetic, ConstantMass)
    assert system.fast_potential is not None
    assert all(map(np.array_equal, jax.tree.leaves(system.kinetic), jax.tree.leaves(hand.kinetic)))
    assert system.num_constraints(problem.q_s, problem.q_f) == hand.num_constraints(problem.q_s, problem.q_f)
    assert float(system.fast_potential(problem.q_f, system.params)) == pytest.approx(
        float(hand.fast_potential(problem.q_f, hand.params)), abs=1e-20
    )

"""The reference systems as scenes: the trajectories of the hand-written ones, bit for bit where the programs are the same."""

import dataclasses

import jax
import numpy as np
import pytest

from tests.scene import reference_scenes
from vmri_jax import ConstantMass, fully_explicit, fully_implicit, simulate, systems

NAMES = ("fermi_pasta_ulam", "triple_spherical_pendulum", "simple_atomic_model")
CASES = [(NAMES[0], fully_explicit(5)), (NAMES[1], fully_implicit(5)), (NAMES[2], fully_implicit(5))]


@pytest.mark.parametrize(("name", "scheme"), CASES)
def test_trajectories_are_equal(name, scheme):
    scene, problem = getattr(reference_scenes, name)(), getattr(systems, name)()
    step = {"macro_dt": 0.01, "num_steps": 200}
    run = simulate(scene.system(), scheme, scene.state(), **step)
    expected = simulate(problem.system, scheme, problem.state(), **step)
    for field in ("t", "q_s", "q_f", "p_s", "p_f"):
        a, b = getattr(run, field), getattr(expected, field)
        if name == "simple_atomic_model":  # its rods are one function by hand, three rows of one in the scene
            assert np.allclose(a, b, rtol=0, atol=1e-11 * np.abs(b).max()), field
        else:
            assert np.array_equal(a, b), field
    assert np.allclose(run.energy, expected.energy, rtol=1e-13, atol=0)  # of other sums: equal to round-off


@pytest.mark.parametrize("name", NAMES)
def test_structure_is_that_of_the_system(name):
    scene, problem = getattr(reference_scenes, name)(), getattr(systems, name)()
    system, hand = scene.system(), problem.system
    for field in dataclasses.fields(system):
        assert (getattr(system, field.name) is None) == (getattr(hand, field.name) is None), field.name
    assert isinstance(system.kinetic, ConstantMass)
    assert all(map(np.array_equal, jax.tree.leaves(system.kinetic), jax.tree.leaves(hand.kinetic)))
    assert system.num_constraints(problem.q_s, problem.q_f) == hand.num_constraints(problem.q_s, problem.q_f)
    assert float(system.fast_potential(problem.q_f, system.params)) == pytest.approx(
        float(hand.fast_potential(problem.q_f, hand.params)), abs=1e-20
    )

"""Vibrations about a start, and who carries them."""

import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from vmri_jax.mechanics.names import Names
from vmri_jax.stability import linear_model, vibrations


def test_two_oscillators_have_their_frequencies_and_names():
    omega, kappa = 50.0, 25.0
    problem = linear_model(omega, kappa)
    named = vm.Problem(problem.system, problem.q_s, problem.q_f, names=Names(slow={"cart": 1}, fast={"bob": 1}))
    seen = vibrations(named)
    squares, modes = np.linalg.eigh([[kappa, -kappa], [-kappa, kappa + omega**2]])
    np.testing.assert_allclose([row.frequency for row in seen.rows], np.sqrt(squares[::-1]), rtol=1e-12)
    np.testing.assert_allclose([row.period for row in seen.rows], 2 * np.pi / np.sqrt(squares[::-1]), rtol=1e-12)
    np.testing.assert_allclose([row.fast_part for row in seen.rows], modes[1, ::-1] ** 2, rtol=1e-9)
    assert [next(iter(row.parts)) for row in seen.rows] == ["bob", "cart"]
    assert seen.growth_rate == 0
    assert [line.split()[-2:] for line in str(seen).splitlines()[1:]] == [["bob", "100%"], ["cart", "100%"]]


def hill(q_s, q_f, params):
    return -2.0 * jnp.sum(q_s**2)


def spring(q_f, params):
    return 8.0 * jnp.sum(q_f**2)


@pytest.mark.parametrize("slow_alone", [True, False])
def test_motions_that_grow_are_said_and_a_part_may_be_empty(slow_alone):
    if slow_alone:
        problem = vm.Problem(vm.System(vm.ConstantMass([1.0], []), hill), [0.0], [])
        seen = vibrations(problem)
        assert seen.growth_rate == pytest.approx(2.0)
        assert "grows by itself, like exp(2 t)" in str(seen)
        assert [(row.frequency, row.period, row.fast_part) for row in seen.rows] == [(0.0, np.inf, 0.0)]
    else:
        problem = vm.Problem(vm.System(vm.ConstantMass([], [1.0]), None, spring), [], [0.5])
        assert [(row.frequency, row.fast_part) for row in vibrations(problem).rows] == [(pytest.approx(4.0), 1.0)]

"""Vibrations about a start, and who carries them."""

import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from vmri_jax.diagnostics import linearise
from vmri_jax.mechanics.linearisation import mass_orthonormal
from vmri_jax.mechanics.names import Names
from vmri_jax.stability import linear_model


def test_two_oscillators_have_their_frequencies_and_names():
    omega, kappa = 50.0, 25.0
    problem = linear_model(omega, kappa)
    named = vm.Problem(problem.system, problem.q_s, problem.q_f, names=Names(slow={"cart": 1}, fast={"bob": 1}))
    linear = linearise(named)
    squares, modes = np.linalg.eigh([[kappa, -kappa], [-kappa, kappa + omega**2]])
    np.testing.assert_allclose(linear.frequencies, np.sqrt(squares[::-1]), rtol=1e-12)
    np.testing.assert_allclose(linear.kinetic_shares, modes[:, ::-1] ** 2, rtol=1e-9)
    heading, *rows = str(linear).splitlines()
    assert heading.split()[:2] == ["frequency", "period"]
    assert [float(row.split()[1]) for row in rows] == pytest.approx(2 * np.pi / np.sqrt(squares[::-1]), rel=1e-3)
    assert [row.split()[-2:] for row in rows] == [["bob", "100%"], ["cart", "100%"]]


def hill(q_s, q_f, params):
    return -2.0 * jnp.sum(q_s**2)


def spring(q_f, params):
    return 8.0 * jnp.sum(q_f**2)


@pytest.mark.parametrize("slow_alone", [True, False])
def test_motions_that_grow_are_said_and_a_part_may_be_empty(slow_alone):
    if slow_alone:
        linear = linearise(vm.Problem(vm.System(vm.ConstantMass([1.0], []), hill), [0.0], []))
        assert linear.growing == pytest.approx([2.0])
        assert "grows by itself, like exp(2 t)" in str(linear)
        assert linear.frequencies == [0.0]
        assert linear.kinetic_shares == pytest.approx(1.0)
    else:
        linear = linearise(vm.Problem(vm.System(vm.ConstantMass([], [1.0]), None, spring), [], [0.0]))
        assert linear.frequencies == pytest.approx([4.0])
        assert "1.571                 100%  q_f[0] 100%" in str(linear)


def test_dependent_rows_count_once_whatever_their_units():
    mass, rows = np.diag([1.0, 4e6, 9.0]), np.array([[1.0, 2e3, 0.0], [1e-9, 2e-6, 0.0], [0.0, 0.0, 0.0]])
    N = mass_orthonormal(mass, rows)
    np.testing.assert_allclose(N.T @ mass @ N, np.eye(2), atol=1e-14)
    np.testing.assert_allclose(rows[:1] @ N, 0, atol=1e-12)

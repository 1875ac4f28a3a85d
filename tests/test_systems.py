# pyright: reportOptionalCall=false, reportAttributeAccessIssue=false
"""The systems of the reference study: formulas, parameters, options."""

import jax.numpy as jnp
import numpy as np
import pytest

from vmri_jax import systems


def test_chain_potentials_are_the_formulas():
    problem = systems.fermi_pasta_ulam(num_springs=4, omega=30.0)
    rng = np.random.default_rng(0)
    s, f = rng.normal(size=(2, 4))
    V = (s[0] - f[0]) ** 4 + (s[3] + f[3]) ** 4
    for i in range(3):
        V += (s[i + 1] - f[i + 1] - s[i] - f[i]) ** 4
    assert float(problem.system.slow_potential(s, f, problem.system.params)) == pytest.approx(V / 4, rel=1e-14)
    assert float(problem.system.fast_potential(f, problem.system.params)) == pytest.approx(450 * f @ f, rel=1e-14)
    assert problem.q_f[0] == pytest.approx(1 / 30)
    assert problem.q_s.shape == (4,)


def test_one_spring_has_two_soft_neighbours():
    problem = systems.fermi_pasta_ulam(num_springs=1)
    s, f = np.array([0.3]), np.array([0.2])
    assert float(problem.system.slow_potential(s, f, problem.system.params)) == pytest.approx((0.1**4 + 0.5**4) / 4)


def test_pendulum_springs():
    q_f = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 3.5])
    for quartic, expected in ((False, 2500 * 0.5**2), (True, 2500 * (3.5**2 - 9) ** 2)):
        system = systems.triple_spherical_pendulum(quartic=quartic).system
        assert float(system.fast_potential(q_f, system.params)) == pytest.approx(expected, rel=1e-14)


def test_pendulum_follows_its_lengths():
    problem = systems.triple_spherical_pendulum(masses=(5.0, 2.0, 1.0), lengths=(4.0, 1.0, 2.0), gravity=1.0)
    assert np.abs(problem.system.constraints(0.0, problem.q_s, problem.q_f)).max() < 1e-14
    assert problem.system.slow_potential(jnp.ones(3), jnp.ones(6), problem.system.params) == pytest.approx(8.0)
    assert np.array_equal(problem.system.kinetic.fast, [2, 2, 2, 1, 1, 1])


def test_atomic_model_starts_unstretched():
    """All rigid and stiff lengths are 10 at the start, and atoms 2 to 5 form a regular tetrahedron."""
    problem = systems.simple_atomic_model()
    q = np.concatenate([problem.q_s, problem.q_f]).reshape(6, 3)
    for i, j in ((1, 2), (1, 3), (1, 4), (2, 3), (3, 4), (4, 2), (2, 5), (0, 1)):
        assert np.linalg.norm(q[i] - q[j]) == pytest.approx(10, abs=1e-13)
    assert np.linalg.norm(q[0]) == pytest.approx(10)
    assert float(problem.system.fast_potential(problem.q_f, problem.system.params)) < 1e-20


def test_atomic_model_potentials_are_the_formulas():
    problem = systems.simple_atomic_model()
    params, masses = problem.system.params, np.array([100, 40, 1, 1, 1, 1.0])
    q = np.random.default_rng(0).normal(size=(6, 3)) * 10

    def stretch(i, j):
        return np.linalg.norm(q[i] - q[j]) - 10

    V = 5 * stretch(0, 1) ** 2 + 0.5 * stretch(1, 2) ** 2 + 9.81 * masses @ q[:, 2]
    W = 2000 * (stretch(2, 3) ** 2 + stretch(3, 4) ** 2 + stretch(4, 2) ** 2)
    q_s, q_f = q[:2].reshape(-1), q[2:].reshape(-1)
    assert float(problem.system.slow_potential(q_s, q_f, params)) == pytest.approx(V, rel=1e-13)
    assert float(problem.system.fast_potential(q_f, params)) == pytest.approx(W, rel=1e-13)
    rigid = [np.sum(q[0] ** 2), *(np.sum((q[i] - q[j]) ** 2) for i, j in ((3, 1), (4, 1), (5, 2)))]
    expected = (np.array([*rigid[1:], rigid[0]]) - 100) / 2
    assert np.allclose(problem.system.constraints(0.0, q_s, q_f), expected, rtol=1e-13)

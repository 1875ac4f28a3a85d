# pyright: reportOptionalCall=false
"""Diagnostics against values written by hand."""

import jax
import numpy as np
import pytest

from tests.support import DATA, PROBLEMS, ground_truth, masses
from tests.user_systems import double_pendulum
from vmri_jax import State
from vmri_jax.diagnostics import (
    constraint_residual,
    energy,
    energy_parts,
    fit_order,
    momentum_map,
    oscillatory_energies,
    rotation_about,
    translation_along,
)


@pytest.mark.parametrize("name", ["fpu3_t1", "fpu3_t100", "tsp_t1", "tsp_t10", "sam_t1"])
def test_energy_of_the_stored_solutions(name):
    """Systems, masses and energies are those of the stored continuous solutions, at every node."""
    assert (DATA / "ground_truth" / f"{name}.npz").exists()
    truth, problem = ground_truth(name), PROBLEMS[name[:3]]()
    n_s = problem.q_s.size

    @jax.jit
    @jax.vmap
    def energies(q, v):
        p = problem.system.kinetic.momentum(v[:n_s], v[n_s:])
        return energy(problem.system, q[:n_s], q[n_s:], *p)

    assert np.allclose(energies(truth["q"], truth["v"]), truth["energy"], rtol=0, atol=1e-9)
    start = problem.state()
    assert np.allclose(np.concatenate([start.q_s, start.q_f]), truth["q"][0], rtol=0, atol=1e-14)
    assert np.allclose(np.concatenate([start.p_s, start.p_f]) / masses(problem), truth["v"][0], rtol=0, atol=1e-13)


def test_energy_parts(tsp):
    state = tsp.state()
    parts = jax.jit(energy_parts)(tsp.system, state.q_s, state.q_f, state.p_s, state.p_f)
    kinetic = np.sum(np.concatenate([state.p_s, state.p_f]) ** 2 / masses(tsp)) / 2
    assert float(parts["kinetic"]) == pytest.approx(kinetic, rel=1e-14)
    assert float(parts["slow"]) == pytest.approx(9.81 * 3.0)  # only the last bob is off the plane z = 0
    assert float(parts["fast"]) == pytest.approx(0.0, abs=1e-12)


def test_energy_of_a_kinetic_function():
    problem = double_pendulum()

    @jax.jit
    def both(state):
        kinetic = problem.system.kinetic_energy(problem.q_s, problem.q_f, problem.v_s, problem.v_f)
        potential = problem.system.slow_potential(problem.q_s, problem.q_f, problem.system.params)
        return energy(problem.system, state.q_s, state.q_f, state.p_s, state.p_f), kinetic + potential

    found, expected = both(problem.state())
    assert float(found) == pytest.approx(float(expected))


def test_oscillatory_energies():
    assert oscillatory_energies(50.0, np.array([0.02, 0.0]), np.array([0.0, 2.0])) == pytest.approx([0.5, 2.0])


def test_constraint_residual_at_both_levels(tsp):
    residual, none = jax.jit(constraint_residual), np.zeros(6)
    q_s = tsp.q_s + 0.1 * np.eye(3)[0]  # |q_1| = 10.1, and the second rod with it
    at_positions = residual(tsp.system, State(0.0, q_s, tsp.q_f, np.zeros(3), none))
    np.testing.assert_allclose(at_positions, [(10.1**2 - 100) / 2, 0.0])
    at_velocities = residual(tsp.system, State(0.0, tsp.q_s, tsp.q_f, np.array([100.0 * 0.5, 0, 0]), none))
    np.testing.assert_allclose(at_velocities, [0.0, 10 * 0.5], atol=1e-12)  # q_1 . v_1


def test_momentum_maps(tsp):
    rng = np.random.default_rng(0)
    q_s, q_f, p_s, p_f = (rng.normal(size=n) for n in (3, 6, 3, 6))
    q, p = np.concatenate([q_s, q_f]).reshape(3, 3), np.concatenate([p_s, p_f]).reshape(3, 3)
    axis = np.array([0.2, -1.0, 2.0])
    kept = jax.jit(lambda *z: [momentum_map(of(axis), *z) for of in (rotation_about, translation_along)])
    np.testing.assert_allclose(kept(q_s, q_f, p_s, p_f), [np.cross(q, p).sum(0) @ axis, p.sum(0) @ axis])


H = np.array([0.1, 0.05, 0.02, 0.01, 0.005, 0.002])


@pytest.mark.parametrize("order", [1, 2, 4, 6])
def test_observed_order_of_a_power(order):
    for h in (H, H[::-1]):
        assert fit_order(h, 3 * h**order).order == pytest.approx(order, abs=1e-10)


def test_observed_order_masks_the_plateau():
    h = np.append(H, 0.001)
    errors = 1e3 * h**6 + 1e-11 * np.array([1.0, 0.7, 1.3, 0.8, 1.1, 0.9, 1.2])
    assert fit_order(h, errors).order == pytest.approx(6, abs=0.2)
    assert np.polyfit(np.log(h), np.log(errors), 1)[0] < 5.5  # without the mask


def test_observed_order_leaves_out_failed_runs_and_errors_below_the_floor():
    errors = np.append(np.nan, 2 * H[1:] ** 2)
    assert fit_order(H, errors).order == pytest.approx(2, abs=1e-10)
    assert fit_order(H, np.maximum(2 * H**4, 1e-7), floor=1e-7).order == pytest.approx(4, abs=0.1)
    with pytest.raises(ValueError, match="1 usable errors of 3; at least 2 are needed"):
        fit_order([0.1, 0.05, 0.02], [1.0, np.nan, np.inf])

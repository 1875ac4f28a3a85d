"""Monodromy: powers of the step where it is linear, tangent spaces where there are constraints."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from tests.stability.systems import double_pendulum, hanging
from vmri_jax import fully_explicit, galerkin, initial_state
from vmri_jax.diagnostics import linearise
from vmri_jax.stability import linear_model, monodromy, multipliers, stability_map
from vmri_jax.steppers.solver import Solver

MARCH = Solver("masses")


def test_powers_of_a_linear_step():
    problem, scheme = linear_model(), fully_explicit(5)
    [(start, stop, _)] = stability_map(problem, scheme, np.linspace(2.9, 3.2, 7)).windows()
    macro_dt = (start + stop) / 2 / 50  # in the first impulse resonance
    once = monodromy(problem, scheme, macro_dt=macro_dt, num_steps=1)
    often = monodromy(problem, scheme, macro_dt=macro_dt, num_steps=40)
    assert often.matrix == pytest.approx(np.linalg.matrix_power(once.matrix, 40), rel=1e-10, abs=1e-9)
    change = np.array([0.1, -0.2, 0.3, 0.4])  # of the start, in the coordinates of the tangents
    assert once.tangents.T @ once.matrix @ change == pytest.approx(once.images.T @ change, abs=1e-12)
    expected = multipliers(linearise(problem), scheme, [macro_dt]).radius[0]
    assert expected > 1.01
    assert np.abs(often.multipliers[0]) == pytest.approx(expected**40, rel=1e-9)
    assert often.symplectic_defect < 1e-13
    assert often.stretch[0] >= np.abs(often.multipliers[0])
    assert float(often.end.t) == pytest.approx(40 * macro_dt)


def drag(t, q_s, q_f, v_s, v_f, params):
    return -0.1 * v_s, -0.1 * v_f


def test_a_dissipative_step_is_not_symplectic():
    problem = linear_model()
    damped = replace(problem, system=problem.system.replace(force=drag))
    found = monodromy(damped, fully_explicit(1), macro_dt=0.02, num_steps=1, solver=MARCH)
    assert found.symplectic_defect > 1e-6  # measured 1.4e-6 of the largest |X_ij|^2; without the force 1e-18


@pytest.fixture(scope="module")
def swinging():
    system = double_pendulum()
    a, b = 0.3, -0.2
    q_s = np.array([np.sin(a), -np.cos(a)])
    return system, initial_state(system, q_s, q_s + np.array([np.sin(b), -np.cos(b)]), [0.0, 0.0], [0.0, 0.0])


def test_on_a_constraint_manifold(swinging):
    """The derivative maps tangent vectors to tangent vectors, keeps the symplectic form, and predicts a neighbour."""
    system, state = swinging
    found = monodromy(system, fully_explicit(3), state, macro_dt=0.03, num_steps=30, solver=MARCH)
    assert found.tangents.shape == found.images.shape == (4, 8)
    assert found.symplectic_defect < 1e-12  # 2e-14
    assert 0.1 < found.closure < 2
    direction = np.array([0.3, -0.5, 0.2, 0.7])
    ends = []
    for sign in (1, -1):
        shift = 1e-5 * sign * direction @ found.tangents
        start = [np.asarray(a) for a in (state.q_s, state.q_f, state.p_s, state.p_f)]
        q_s, q_f, p_s, p_f = (a + d for a, d in zip(start, np.split(shift, 4), strict=True))
        moved = initial_state(system, q_s, q_f, p_s / 5, p_f, project=True)
        end = monodromy(system, fully_explicit(3), moved, macro_dt=0.03, num_steps=30, solver=MARCH).end
        ends.append(np.concatenate([end.q_s, end.q_f, end.p_s, end.p_f]))
    predicted = direction @ found.images
    assert (ends[0] - ends[1]) / 2e-5 == pytest.approx(predicted, abs=1e-5 * np.abs(predicted).max())


def test_at_rest_the_multipliers_of_constraints_count():
    """Corrections of a step at rest are zero from the first pass on, and the weights that the rods carry make its
    frequencies."""
    system = double_pendulum()
    at_rest = monodromy(system, galerkin(2, 2), hanging(system), macro_dt=0.05, num_steps=1, solver=MARCH)
    frequencies = linearise(system, hanging(system)).frequencies
    angles = np.abs(np.angle(at_rest.multipliers))
    np.testing.assert_allclose(np.sort(angles), 0.05 * np.repeat(frequencies[::-1], 2), rtol=3e-4)  # 2e-4
    assert at_rest.symplectic_defect < 1e-13  # 1e-3 with the multipliers of the guess


def test_failing_steps_and_bad_input(swinging):
    system, state = swinging
    with pytest.raises(RuntimeError, match=r"macro step \d+ failed: "):
        monodromy(system, fully_explicit(3), state, macro_dt=30.0, num_steps=30, solver=MARCH)
    with pytest.raises(ValueError, match="num_steps is 0"):
        monodromy(system, fully_explicit(3), state, macro_dt=0.03, num_steps=0)
    with pytest.raises(ValueError, match="macro_dt is -1"):
        monodromy(system, fully_explicit(3), state, macro_dt=jnp.asarray(-1.0), num_steps=3)

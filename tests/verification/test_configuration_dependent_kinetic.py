# pyright: reportCallIssue=false
"""A user's own system whose kinetic energy depends on the configuration: a double pendulum in angles.

The heavy long arm is slow, the light short one fast. The reference is a high-order, very fine run that conserves the
energy to round-off.
"""

import numpy as np
import pytest

from tests.support import NAMES, area_change, joined, largest_difference, node
from tests.user_systems import arms_kinetic, arms_weight, double_pendulum
from vmri_jax import explicit_slow, fully_implicit, galerkin, initial_state, simulate
from vmri_jax.diagnostics import fit_order

SCHEMES = {
    "fully implicit": (fully_implicit(5), (80, 160, 320), 2),
    "explicit slow": (explicit_slow(5), (80, 160, 320), 2),
    "gauss 2": (galerkin(5, 2), (20, 40, 80), 4),
}


@pytest.fixture(scope="module")
def problem():
    return double_pendulum()


def run_of(problem, name, num_steps, macro_dt=None, state=None):
    """To time 1 if no step is given. All runs have 20 saved intervals, so that tests share compiled runs."""
    state, macro_dt = state or problem.state(), macro_dt or 1 / num_steps
    every = num_steps // 20
    return simulate(problem.system, SCHEMES[name][0], state, macro_dt=macro_dt, num_steps=num_steps, save=every)


@pytest.fixture(scope="module")
def reference(problem):
    run = run_of(problem, "gauss 2", 1600)
    assert np.abs(run.energy / run.energy[0] - 1).max() < 1e-11
    return run


@pytest.mark.parametrize("name", SCHEMES)
def test_order(problem, reference, name):
    _, steps, order = SCHEMES[name]
    runs = [run_of(problem, name, n) for n in steps]
    errors = [[largest_difference(getattr(run, k), getattr(reference, k)) for k in NAMES] for run in runs]
    observed = [fit_order(1 / np.array(steps), e).order for e in np.transpose(errors)]
    assert observed == pytest.approx([order] * 4, abs=0.15)  # measured 0.033, 0.2 wanted


@pytest.mark.parametrize("name", ["fully implicit", "gauss 2"])
def test_energy_band_without_drift(problem, name):
    pieces = [run_of(problem, name, 2000, 0.02)]
    for _ in range(2):
        pieces.append(run_of(problem, name, 2000, 0.02, pieces[-1].final_state))
    run = joined(pieces)
    energy = np.asarray(run.energy) / abs(float(run.energy[0]))
    drift = np.polyfit(np.linspace(0, 1, energy.size), energy, 1)[0]
    assert np.ptp(energy) < {"fully implicit": 1e-3, "gauss 2": 1e-7}[name]  # measured 2.0e-4, 1.9e-8
    assert abs(drift) < 0.1 * np.ptp(energy)  # measured 0.01


def test_symplectic(problem):
    def ends(x):
        at = problem.q_s, problem.q_f, problem.v_s, problem.v_f
        start = initial_state(problem.system, *(a + dx for a, dx in zip(at, np.split(x, 4), strict=True)))
        return start, node(run_of(problem, "fully implicit", 20, 0.02, start), 1)

    assert area_change(ends, 4) < 1e-11


def test_the_formulas_of_the_example(problem):
    """Cartesian positions of the two bobs give the same energies."""
    params = problem.system.params
    (m_1, m_2), (l_1, l_2) = np.asarray(params["masses"]), np.asarray(params["lengths"])
    a, b, u, w = 0.3, 1.1, 0.7, -0.4
    v_1 = l_1 * u * np.array([np.cos(a), np.sin(a)])
    v_2 = v_1 + l_2 * w * np.array([np.cos(b), np.sin(b)])
    expected = m_1 / 2 * v_1 @ v_1 + m_2 / 2 * v_2 @ v_2
    assert float(arms_kinetic(*(np.array([x]) for x in (a, b, u, w)), params)) == pytest.approx(expected, rel=1e-14)
    heights = -l_1 * np.cos(a), -l_1 * np.cos(a) - l_2 * np.cos(b)
    expected = 9.81 * (m_1 * heights[0] + m_2 * heights[1])
    assert float(arms_weight(np.array([a]), np.array([b]), params)) == pytest.approx(expected, rel=1e-14)

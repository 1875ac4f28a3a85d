"""Exchange of energy between the stiff springs of the FPU chain over long times, and their adiabatic invariant."""

import numpy as np
import pytest

from vmri_jax import fully_implicit, simulate
from vmri_jax.diagnostics import oscillatory_energies

# mean of I_1, I_2, I_3 over windows of width 10 around t
WINDOWS = {50: (0.5573, 0.3711, 0.0721), 100: (0.1059, 0.4134, 0.4813), 150: (0.0128, 0.0521, 0.9356)}


@pytest.fixture(scope="module")
def long_run(fpu):
    run = simulate(fpu.system, fully_implicit(10), fpu.state(), macro_dt=0.1, num_steps=2000)
    return np.asarray(run.t), np.asarray(oscillatory_energies(50.0, run.q_f, run.p_f)), np.asarray(run.energy)


def test_energy_of_the_start(long_run):
    assert long_run[2][0] == pytest.approx(2.00120008, abs=1e-8)
    assert np.abs(long_run[2] - long_run[2][0]).max() < 1e-2


@pytest.mark.parametrize("t", WINDOWS)
def test_window_means_of_the_oscillatory_energies(long_run, t):
    times, energies, _ = long_run
    means = energies[np.abs(times - t) <= 5 + 1e-9].mean(axis=0)
    assert means == pytest.approx(WINDOWS[t], abs=0.05)  # measured 0.042, 0.013, 0.028


def test_total_oscillatory_energy_stays_in_its_band(long_run):
    total = long_run[1].sum(axis=1)
    assert total.min() > 0.92  # measured 0.9330; 0.9376 of the continuous solution, O(omega^2 h^2) lower
    assert total.max() < 1.08  # measured 1.0723; 1.0623 of the continuous solution
    assert total[0] == pytest.approx(1.0, abs=1e-12)

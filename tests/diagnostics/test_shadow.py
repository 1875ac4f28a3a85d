"""The drift meter: shadow energies stand still where energies oscillate, and show drifts that are far below the
band."""

from itertools import pairwise

import numpy as np
import pytest

import vmri_jax as vm
from tests.support import PROBLEMS
from vmri_jax.diagnostics import shadow_energy

CHAIN = vm.systems.fermi_pasta_ulam(1, omega=20.0)
SCHEME = vm.explicit_slow(4)


def gain(t, q_s, q_f, v_s, v_f, params):
    """A force along the velocities."""
    return params["gain"] * v_s, params["gain"] * v_f


STEPS = 10_000
"""Of all runs of the chain, so that tests share compiled programs."""


@pytest.fixture(scope="module")
def run():
    return vm.simulate(CHAIN, SCHEME, macro_dt=0.01, num_steps=STEPS)


@pytest.mark.parametrize(
    ("name", "scheme", "macro_dt", "least"),
    [
        ("fpu", vm.explicit_slow(10), 0.005, 1e6),  # measured 4e6
        ("fpu", vm.compose(vm.fully_explicit(2), "suzuki4"), 0.01, 30),  # the energy itself is kept better: 80
        pytest.param("tsp", vm.explicit_slow(10), 0.001, 1e5, marks=pytest.mark.full),  # 2e6
        pytest.param("sam", vm.explicit_slow(10), 0.002, 1e5, marks=pytest.mark.full),  # 3e5
    ],
)
def test_it_stands_still(name, scheme, macro_dt, least):
    problem = PROBLEMS[name]()
    found = shadow_energy(problem, scheme, vm.simulate(problem, scheme, macro_dt=macro_dt, num_steps=1000))
    assert found.ratio > least
    assert not found.drifts


def test_its_band_shrinks_with_k(run):
    """Like (omega H)^(2 k)."""
    bands = [shadow_energy(CHAIN, SCHEME, run, k).band for k in (1, 2, 3, 4)]
    assert all(after < 0.1 * before for before, after in pairwise(bands))


def test_degree_two_with_constraints():
    problem, scheme = PROBLEMS["tsp"](), vm.galerkin(2, 2)
    run = vm.simulate(problem, scheme, macro_dt=0.002, num_steps=300)
    found = shadow_energy(problem, scheme, run)
    assert found.band < 1e-8  # measured 2e-9 of 81 J
    assert found.energy[0] == pytest.approx(float(run.energy[0]), rel=1e-5)


@pytest.mark.parametrize("per_step", [1e-12, -3e-12])
def test_a_drift_that_is_put_in_is_found(per_step, run):
    """Of the relative energy per step, within 10^4 steps; the band of the energy is 10^5 times what they add up to."""
    kinetic = float(
        np.mean(run.energy)
    )  # about: the share of the energy that the force acts on is half of it on average
    forced = CHAIN.system.replace(force=gain, params=CHAIN.system.params | {"gain": per_step / 0.01 / 2})
    driven = vm.simulate(forced, SCHEME, CHAIN.state(), macro_dt=0.01, num_steps=STEPS)
    found = shadow_energy(CHAIN, SCHEME, driven, k=7)
    per_time = per_step / 0.01 * kinetic / 2
    assert found.drifts
    assert found.drift == pytest.approx(per_time, rel=0.3)
    assert 1e4 * abs(per_step) * kinetic < 1e-3 * found.energy_band


def test_no_drift_where_there_is_none(run):
    found = shadow_energy(CHAIN, SCHEME, run, k=6)
    assert not found.drifts
    assert "no drift is seen" in str(found)


def test_refusals(run):
    sparse = vm.simulate(CHAIN, SCHEME, macro_dt=0.01, num_steps=400, save=4)
    with pytest.raises(ValueError, match="every macro node saved"):
        shadow_energy(CHAIN, SCHEME, sparse)
    with pytest.raises(ValueError, match="at least 31 nodes"):
        shadow_energy(CHAIN, SCHEME, run[:20])
    with pytest.raises(ValueError, match="the system has forces"):
        shadow_energy(CHAIN.system.replace(force=gain), SCHEME, run)
    with pytest.raises(ValueError, match="mollified"):
        shadow_energy(CHAIN, vm.mollified_impulse(4), run)
    with pytest.raises(ValueError, match="k is 0"):
        shadow_energy(CHAIN, SCHEME, run, k=0)

"""Forces that act for a short time: runs of an accuracy see them, and runs with steps of the user say where they do
not."""

import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from vmri_jax.accuracy.companions import UncertifiedWarning

LENGTH = 10.0
RECTANGLE, BUMP, GAUSS, STEP, BURST, SINE, CHIRP, SHOCK = range(8)


def history(t, params, xp=jnp):
    """The force at time t: one of eight, of the same program."""
    s = (t - params["center"]) / params["width"]
    inside = (s > 0) & (s < 1)
    kinds = (
        inside,
        inside * xp.sin(np.pi * s) ** 2,
        xp.exp(-xp.minimum(s**2, 600.0) / 2),
        s >= 0,
        inside * xp.sin(10 * np.pi * s),
        xp.sin(np.pi * s),
        xp.sin(t**2 / params["width"]),
        (s >= 0) * xp.exp(-xp.clip(s, 0.0, 600.0)),
    )
    return params["size"] * sum((params["kind"] == i) * value for i, value in enumerate(kinds))


def spring(q_s, q_f, params):
    return jnp.sum(q_s**2) / 2


def force(t, q_s, q_f, v_s, v_f, params):
    return history(t, params)[None], jnp.zeros(0)


def oscillator(kind: float, center: float, width: float, size: float) -> vm.Problem:
    params = {"kind": float(kind), "center": center, "width": width, "size": size}
    return vm.Problem(vm.System(vm.ConstantMass([1.0], []), spring, force=force, params=params), [1.0], [])


def motion(t, params) -> np.ndarray:
    """``x(t) = cos t + int_0^t sin(t - s) F(s) ds``, by Gauss quadrature between times among which are t, and all jumps
    and kinks of F."""
    t = np.minimum(t, LENGTH)
    dense = params["center"] + params["width"] * np.linspace(-8, 8, 1601)
    edges = np.unique(np.clip(np.concatenate([np.linspace(0, LENGTH, 20001), dense, t]), 0, LENGTH))
    nodes, weights = np.polynomial.legendre.leggauss(4)
    half = np.diff(edges)[:, None] / 2
    s = edges[:-1, None] + half * (1 + nodes)
    work = half * weights * history(s, params, np)
    cosine, sine = (
        np.append(0.0, np.cumsum((work * f(s)).sum(axis=1)))[np.searchsorted(edges, t)] for f in (np.cos, np.sin)
    )
    return np.cos(t) + np.sin(t) * cosine - np.cos(t) * sine


@pytest.mark.parametrize(
    ("kind", "center", "width", "size", "accuracy"),
    [
        (GAUSS, 3.3, 1e-3, 400.0, 1e-5),  # an impulse of 1, in steps of the menu overlooked
        (RECTANGLE, 7.123, 0.03, 20.0, 1e-2),
        (BUMP, 1.03, 0.03, 30.0, 1e-4),
        (STEP, 3.777, 1.0, 1.0, 1e-3),
        (BURST, 5.55, 0.3, 5.0, 1e-4),
    ],
)
def test_an_estimate_has_seen_the_force(kind, center, width, size, accuracy):
    problem = oscillator(kind, center, width, size)
    run = vm.simulate(problem, vm.fully_explicit(1), accuracy=accuracy, t_end=LENGTH)
    true = np.abs(run.q_s[:, 0] - motion(np.asarray(run.t), problem.system.params)).max()
    assert run.error.largest <= accuracy
    assert true <= 3 * run.error.largest  # 0.2 to 1.03 measured
    if kind == STEP:  # of order one
        assert true >= 0.8 * run.error.largest


TWENTY = [
    *((STEP, center, 1.0, 1.0) for center in (0.123, 3.333, 7.77)),
    *((RECTANGLE, *pulse) for pulse in ((2.71, 0.3, 1.0), (5.123, 0.03, 20.0))),
    *((GAUSS, *pulse) for pulse in ((3.3, 1e-3, 400.0), (6.1803, 0.01, 40.0), (4.0, 0.1, 3.0))),
    *((BUMP, *bump) for bump in ((1.03, 0.03, 30.0), (1.03, 0.3, 3.0), (8.8, 1e-3, 1e3))),
    *((BURST, *burst) for burst in ((3.3, 0.1, 10.0), (6.66, 0.5, 5.0), (1.2, 0.03, 30.0))),
    *((SINE, *wave) for wave in ((0.3, 0.7, 1.0), (0.0, 0.05, 10.0))),
    *((CHIRP, 0.0, width, 2.0) for width in (1.0, 0.2)),
    *((SHOCK, *shock) for shock in ((2.2, 0.05, 10.0), (4.7, 0.3, 2.0))),
]
NO_JUMP = (GAUSS, BUMP, BURST, SINE, CHIRP)
"""Forces that jump lower the order to 1: an accuracy of 1e-7 takes them millions of steps."""


@pytest.mark.full
@pytest.mark.parametrize(
    ("drive", "accuracy"), [(d, a) for a in (1e-3, 1e-5, 1e-7) for d in TWENTY if a == 1e-3 or d[0] in NO_JUMP]
)
def test_twenty_drives(drive, accuracy):
    problem = oscillator(*drive)
    run = vm.simulate(problem, accuracy=accuracy, t_end=LENGTH)
    true = np.abs(run.q_s[:, 0] - motion(np.asarray(run.t), problem.system.params)).max()
    assert run.error.largest <= accuracy
    assert true <= 3 * run.error.largest + 1e-10  # the reference is good to 1e-11


def test_steps_over_a_pulse_are_not_certified():
    problem = oscillator(GAUSS, 3.3, 1e-3, 400.0)
    with pytest.warns(UncertifiedWarning, match=r"from t = 3\.298 on no error is certified: force of the system.*take"):
        run = vm.simulate(problem, vm.fully_explicit(1), macro_dt=0.1, t_end=LENGTH, error=True)
    assert 2.0 <= float(run.error.certified_until) <= 3.2  # the third companion has a node in common every 2.0
    with pytest.warns(UncertifiedWarning, match="from t = 0 on no error is certified"):
        vm.simulate(oscillator(GAUSS, 5e-4, 1e-3, 400.0), vm.fully_explicit(1), macro_dt=0.1, t_end=LENGTH, error=True)
    smaller = vm.simulate(problem, vm.fully_explicit(1), macro_dt=0.0005, t_end=LENGTH, save=200, error=True)
    true = np.abs(smaller.q_s[:, 0] - motion(np.asarray(smaller.t), problem.system.params)).max()
    assert smaller.error.largest == pytest.approx(true, rel=0.1)  # 0.2 % measured


def test_errors_of_driven_runs_keep_their_signs():
    """The third companion has every twentieth node in common: nodes between these have errors of their own."""
    problem, scheme = oscillator(SINE, 0.0, 0.7, 1.0), vm.fully_explicit(1)
    run = vm.simulate(problem, scheme, macro_dt=0.1, t_end=LENGTH, error=lambda run: run.q_s[:, 0])
    true = run.q_s[:, 0] - motion(np.asarray(run.t), problem.system.params)
    for error in (run.error.q_s[:, 0], run.error.of):
        np.testing.assert_allclose(error, true, atol=0.05 * np.abs(true).max())  # 0.01 measured
    shares = vm.simulate(problem, scheme, macro_dt=0.1, t_end=LENGTH, error="shares").error
    slow = np.abs(np.abs(true) - np.multiply.outer((1, -1), shares.fast))  # of equal and of opposite signs
    assert np.abs(slow - shares.slow).min(axis=0).max() <= 0.05 * np.abs(true).max()  # 0.01 measured


def test_errors_of_functions_know_jumps():
    problem, scheme = oscillator(STEP, 3.777, 1.0, 1.0), vm.fully_explicit(1)
    run = vm.simulate(problem, scheme, macro_dt=0.1, t_end=LENGTH, error=lambda run: run.q_s[:, 0])
    assert np.abs(run.error.of).max() == pytest.approx(run.error.largest)


def test_events_demand_many_steps(monkeypatch):
    monkeypatch.setattr("vmri_jax.accuracy.search.MANY_STEPS", 100)
    with pytest.warns(UserWarning, match="force of the system changes and changes back within 0.03"):
        vm.simulate(oscillator(RECTANGLE, 7.123, 0.03, 20.0), vm.fully_explicit(1), accuracy=1e-1, t_end=LENGTH)


def test_events_that_no_run_sees_are_refused(monkeypatch):
    """The menu goes on with steps that have more nodes, 667 of them, and without any is refused before a run."""
    problem = oscillator(RECTANGLE, 7.123, 0.03, 20.0)
    monkeypatch.setattr("vmri_jax.accuracy.companions.MOST_STEPS", 1000)
    run = vm.simulate(problem, accuracy=1e-1, t_end=LENGTH)
    assert run.settings.python.startswith("vm.galerkin(1, 2")
    with pytest.raises(vm.Refused, match=r"near t = 7.15. force of the system.* 1.3e\+03 macro steps"):
        vm.simulate(problem, vm.fully_explicit(1), accuracy=1e-1, t_end=LENGTH)


def springs(q_s, q_f, params):
    return 9e3 * (q_f["z"] - q_f["u"]) ** 2 + 1e5 * q_f["u"] ** 2


def road(t, q_s, q_f, v_s, v_f, params):
    damper, s = 40.0 * (v_f["z"] - v_f["u"]), (t - 1.03) / 0.03
    bump = 0.05 * jnp.where((s > 0) & (s < 1), jnp.sin(jnp.pi * s) ** 2, 0.0)
    return {}, {"z": -damper, "u": damper + 2e5 * bump}


@pytest.mark.parametrize("num_saves", [None, 20])
def test_a_car_at_rest_crosses_a_bump(num_saves):
    """The car is at rest at first, so that long steps have no error; at twenty saved nodes it has hardly moved."""
    system = vm.System(vm.ConstantMass(slow={}, fast={"z": 300.0, "u": 40.0}), springs, force=road)
    car = vm.Problem(system, q_s={}, q_f={"z": 0.0, "u": 0.0})
    run = vm.simulate(car, vm.fully_explicit(1), accuracy=1e-4, t_end=5.0, save=vm.Save(number=num_saves))
    assert 1e-6 < run.error.largest <= 1e-4
    assert float(run.q_f["z"][-1]) == pytest.approx(-3.9413e-3, abs=2e-5)

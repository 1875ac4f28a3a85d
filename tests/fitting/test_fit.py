"""Identification: parameters are found within their errors, intervals cover, and what cannot work is refused."""

import sys
from dataclasses import replace
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.small_systems import driven
from vmri_jax.fitting import Measured, Unknown
from vmri_jax.fitting.fit import _model
from vmri_jax.fitting.given import Unknowns, positions
from vmri_jax.fitting.shooting import Shooting
from vmri_jax.schemes.composition import SchemeLike

CHAIN = vm.systems.fermi_pasta_ulam(1, omega=20.0)
SCHEME = vm.compose(vm.fully_explicit(2), "kahan-li8")  # of order 8: its steps leave no error in the parameters
DT = 0.05


def measured(steps=60, sigma=1e-3, seed=0, problem=CHAIN, dt=DT, scheme: SchemeLike = SCHEME):
    """Noisy positions of a run."""
    run = vm.simulate(problem, scheme, macro_dt=dt, num_steps=steps)
    q = np.concatenate([run.q_s, run.q_f], axis=1)
    noise = np.random.default_rng(seed).standard_normal(q.shape)
    return Measured(run.t, q + sigma * noise, sigma=sigma)


def product(parameters):
    """Only the product of two parameters counts."""
    return replace(CHAIN, system=CHAIN.system.replace(params={"omega": parameters["a"] * parameters["b"]}))


def slow_position(state):
    return state.q_s[0]


def fit_of_two(data):
    """The names are not in alphabetical order, in which JAX sorts the names of a dictionary."""
    return vm.fit(CHAIN, data, {"v_s": CHAIN.v_s + 0.05, "omega": Unknown(19.5, lower=0)}, scheme=SCHEME, macro_dt=DT)


@pytest.fixture(scope="module")
def found():
    return fit_of_two(measured())


def test_parts_of_a_driven_motion_start_at_their_times():
    """From the starts of a single run each part ends where the next one starts."""

    def model(values):
        return replace(driven(), v_f=driven().v_f * values["speed"])

    data = measured(steps=24, problem=driven(), scheme=vm.fully_explicit(2))
    unknowns, steps, u = Unknowns({"speed": Unknown(1.0)}), [np.arange(25)], np.zeros(1)
    shooting = Shooting(model, unknowns, [data], steps, vm.fully_explicit(2), vm.Solver("masses"), DT, 3)
    _, gaps = jax.jit(shooting.predict)(u, shooting.starts(u))
    assert np.abs(gaps).max() < 1e-12


def test_parameters_are_found_within_their_errors(found):
    truth = {"v_s[0]": float(CHAIN.v_s[0]), "omega": 20.0}
    assert found.success
    assert found.labels == list(truth)
    for label, (low, high) in found.intervals(0.9999).items():
        assert low < truth[label] < high
    assert found.standard_errors["omega"] < 0.01
    assert 0.01 < found.probability < 0.99
    assert not found.undetermined
    assert "chance of worse" in str(found)
    assert " +- 200 " in str(replace(found, covariance=4e4 * np.eye(2)))
    titles = [axes.get_title(loc="left") for axes in vm.plots.plot_fit(found).axes]
    assert "correlations" in titles
    assert len(titles) == 4  # with the bar of colours


def test_the_run_of_a_fit_goes_to_the_last_measurement(found):
    run = found.simulate()
    assert run.t[-1] == pytest.approx(60 * DT)
    misses = np.concatenate([run.q_s, run.q_f], axis=1) - found.shooting.data[0].values
    np.testing.assert_allclose(misses.ravel() / 1e-3, found.residuals, atol=1e-6)


def test_intervals_cover(found):
    """Of 100 intervals of 95 %, 95 +- 2."""
    bootstrap = found.bootstrap(100)
    coverage = bootstrap.coverage()
    assert "Bootstrap of 100 fits" in repr(bootstrap)
    assert all(0.9 < part < 0.99 for part in coverage.values())
    with pytest.raises(ValueError, match="level is 95; it must lie between 0 and 1"):
        bootstrap.coverage(95)
    with pytest.raises(ValueError, match="repeats is 0"):
        found.bootstrap(0)


BODIES = [vm.scene.Body("a", 1.0, [0.0]), vm.scene.Body("b", 1.0, [1.2])]
BONDED = vm.scene.Scene(BODIES, [vm.scene.Spring(("a", "b"), 40.0, 1.0, name="bond")])
"""A scene without fast variables; numbers of a scene have the names of their effects."""


def test_steps_that_move_the_parameters_are_doubted():
    """A leapfrog at ``omega h = 0.45`` is too fast by a hundredth, and the fitted stiffness too low."""
    assert not BONDED.problem().q_f.size
    t, single = DT * np.arange(61), vm.fully_explicit(1)
    away = 0.1 - 0.1 * np.cos(80**0.5 * t) + 1e-3 * np.random.default_rng(0).standard_normal(61)
    data = Measured(t, away, sigma=1e-3, observe=slow_position)
    coarse = vm.fit(BONDED, data, {"bond.stiffness": Unknown(39.5, lower=0)}, scheme=single, macro_dt=DT)
    assert "too large for this data: half the steps would change bond.stiffness by +" in str(coarse)
    assert "95 %" not in str(coarse)
    missing = 40.0 - coarse.values[0]
    assert len(vm.plots.plot_fit(coarse).axes) == 2  # a single parameter has no correlations
    assert missing > 10 * coarse.standard_errors["bond.stiffness"]
    assert coarse.change_by_half_steps[0] == pytest.approx(3 / 4 * missing, rel=0.2)  # order 2
    with pytest.warns(vm.UncertifiedWarning, match="intervals: the fit is doubted.*The steps"):
        coarse.intervals()


def test_some_values_of_some_quantities_without_their_sigma(found):
    """Derivatives of equations that are solved by iteration are in `tests/verification/test_gradients.py`."""
    whole = measured()
    values = whole.values.copy()
    values[::3, 0] = np.nan
    slow = Measured(whole.t[10:30], whole.values[10:30, 0], observe=slow_position)
    fit = fit_of_two([Measured(whole.t, values), slow])
    assert len(fit.residuals) == np.isfinite(values).sum() + 20
    assert fit.parameters["omega"] == pytest.approx(20.0, abs=5 * fit.standard_errors["omega"])
    assert fit.sigma == pytest.approx(1e-3, rel=0.2)
    assert fit.standard_errors["omega"] == pytest.approx(found.standard_errors["omega"], rel=0.2)
    assert "sigma estimated" in str(fit)


@pytest.mark.parametrize(
    ("unknown", "low", "high"),
    [
        (Unknown(2.0, lower=0), 0, np.inf),
        (Unknown(-2.0, upper=1.0), -np.inf, 1),
        (Unknown([0.5, 2.0], lower=0, upper=[1.0, 3.0]), 0, 3),
        (Unknown(0.0), -np.inf, np.inf),
    ],
)
def test_bounds_are_kept(unknown, low, high):
    for u in (-30.0, -1.0, 0.0, 2.0, 30.0):
        at = np.asarray(unknown.at(np.full(unknown.start.shape, u)))
        assert np.all((low <= at) & (at <= high))
    np.testing.assert_allclose(unknown.at(np.zeros(unknown.start.shape)), unknown.start, atol=1e-15)


def test_labels():
    assert Unknowns({"m": Unknown([1.0, 2.0]), "k": Unknown(3.0)}).labels == ["m[0]", "m[1]", "k"]


GOOD = measured(5)
LITTLE = Measured([0.05], [0.0], sigma=1.0, observe=slow_position)


def without_b(parameters):
    return replace(CHAIN, system=CHAIN.system.replace(params={"omega": parameters["a"]}))


def of_whole(parameters):
    return without_b({"a": float(parameters["a"])})


@pytest.mark.parametrize(
    ("message", "call"),
    [
        ("sigma is 0.0; it must be positive", lambda: Measured([0.1], [1.0], sigma=0.0)),
        ("sigma has shape", lambda: Measured([0.1], [[1.0, 2.0]], sigma=[1.0, 1.0, 1.0])),
        ("one row for each time", lambda: Measured([0.1, 0.2], [1.0])),
        ("must lie between lower", lambda: Unknown(1.0, lower=2.0)),
        ("scale is -1.0", lambda: Unknown(1.0, scale=-1.0)),
        ("the time 0.07 lies between its nodes", lambda: fit(Measured([0.07], [[0.0, 0.0]], sigma=1.0))),
        ("lies before the start", lambda: fit(Measured([-0.05], [[0.0, 0.0]], sigma=1.0))),
        ("'stifness', which is none of system.params", lambda: fit(GOOD, {"stifness": 1.0})),
        (
            r"'bond.length_', which is none of system.params .* \(bond.length",
            lambda: fit(GOOD, {"bond.length_": 1.0}, model=BONDED),
        ),
        ("start of 'omega' has shape", lambda: fit(GOOD, {"omega": [1.0, 2.0]})),
        ("parameters is empty", lambda: fit(GOOD, {})),
        ("data is empty", lambda: fit([])),
        ("fit: data", lambda: fit([np.zeros(3)])),
        ("some of data have a sigma", lambda: fit([GOOD, Measured(GOOD.t, GOOD.values)])),
        ("1 values for 2 unknown numbers", lambda: fit(LITTLE, {"omega": 1.0, "v_s": [0.0]})),
        ("all measurements are at the start of the", lambda: fit(Measured([0.0], [[0.0, 0.0]], sigma=1.0))),
        ("the model", lambda: vm.fit(cast(Any, lambda p: 3), GOOD, {"a": 1.0}, scheme=SCHEME, macro_dt=DT)),
        ("segments is 0", lambda: fit(GOOD, segments=0)),
        ("problem cannot be traced, line .* of test_fit.py", lambda: fit(GOOD, {"a": 19.0}, model=of_whole)),
        ("no measured value depends on b", lambda: fit(GOOD, {"a": 19.0, "b": 1.0}, model=without_b)),
        ("start is a dict; name its numbers one by one", lambda: Unknown(cast(Any, {"stiffness": 1.0}))),
        (
            "1 values for 1 unknown numbers and sigma",
            lambda: fit(Measured([0.05], [0.0], observe=slow_position), {"omega": 1.0}),
        ),
        ("spread is nan", lambda: fit(GOOD, spread=np.nan)),
        ("seed is -1", lambda: fit(GOOD, seed=-1)),
        ("fit: macro_dt is -0.05", lambda: vm.fit(CHAIN, GOOD, {"omega": 1.0}, scheme=SCHEME, macro_dt=-DT)),
        ("lower is -inf; it must be finite, or None", lambda: Unknown(1.0, lower=-np.inf)),
        ("scale is inf; it must be finite, or None", lambda: Unknown(1.0, scale=np.inf)),
        ("but for NaN in place of missing values", lambda: Measured([0.1, 0.2], [1.0, np.inf])),
        (r"observe is <lambda>\(state, params\)", lambda: watched(lambda state, params: state.q_f)),
        (r"observe returns shape \(1,\); it must return 2 real", lambda: watched(lambda state: state.q_f)),
        ("observe returns dict; it must return 2 real", lambda: watched(lambda state: {"q": state.q_f})),
        (r"observe returns \[.*nan.*\] at t = ", lambda: watched(lambda state: jnp.log(positions(state)))),
    ],
)
def test_bad_input(message, call):
    with pytest.raises(vm.Refused, match=message):
        call()


def watched(observe):
    return fit(Measured(GOOD.t, GOOD.values, sigma=1.0, observe=observe))


def fit(data, parameters=None, model: Any = CHAIN, **options):
    parameters = {"omega": 19.0} if parameters is None else parameters
    return vm.fit(model, data, parameters, scheme=SCHEME, macro_dt=DT, **options)


def test_without_optimistix(monkeypatch):
    monkeypatch.setitem(sys.modules, "optimistix", None)
    with pytest.raises(ImportError, match=r"vmri_jax\[fit\]"):
        fit(GOOD)


def spring(q_s, q_f, params):
    return params["stiffness"] * (q_s @ q_s + q_f @ q_f) / 2


@pytest.mark.full
def test_systems_without_slow_variables_are_fitted():
    """Those without fast variables are in the test of steps that move the parameters."""
    system = vm.System(vm.ConstantMass([], [1.0]), spring, params={"stiffness": np.array(8.0)})
    problem = vm.Problem(system, [], [1.0])
    run = vm.simulate(problem, vm.fully_explicit(1), macro_dt=0.05, num_steps=6)
    data = Measured(run.t, run.q_f, sigma=1e-3, observe=lambda s: s.q_f)
    found = vm.fit(problem, data, {"stiffness": Unknown(7.0, lower=0)}, scheme=vm.fully_explicit(1), macro_dt=0.05)
    assert found.parameters["stiffness"] == pytest.approx(8.0, abs=1e-9)  # measured: 1e-13


def test_a_single_number_of_the_start_is_an_unknown(fpu):
    model = _model(fpu, {"q_f[1]": 0.5})
    np.testing.assert_array_equal(model({"q_f[1]": 0.7}).q_f, [fpu.q_f[0], 0.7, *fpu.q_f[2:]])

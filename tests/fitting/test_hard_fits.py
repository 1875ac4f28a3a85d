"""Fits that are hard: long motions, starts far away, parameters that the data do not determine."""

from dataclasses import replace

import numpy as np
import pytest

import vmri_jax as vm
from tests.fitting.test_fit import CHAIN, DT, SCHEME, measured, product, spring
from tests.support import PROBLEMS
from vmri_jax.fitting import Unknown
from vmri_jax.fitting.given import Unknowns
from vmri_jax.fitting.shooting import Shooting


def fit_of_long_motion(**options):
    """From a frequency that is off by two per cent, so that the fast phase is wrong by more than a turn at the end."""
    data, start = measured(steps=400, sigma=1e-4), {"omega": Unknown(20.4, lower=0)}
    return vm.fit(CHAIN, data, start, scheme=SCHEME, macro_dt=DT, **options)


def test_long_motion_in_one_part_is_doubted():
    fit = fit_of_long_motion()
    assert fit.probability < 1e-6
    assert "starts=8 or segments=10" in str(fit)
    assert "95 %" not in str(fit)  # an interval of a wrong fit says nothing
    assert "starts=8" not in str(replace(fit, squares=np.ones(8)))


def test_long_motion_in_several_parts():
    fit = fit_of_long_motion(segments=10)
    assert fit.values[0] == pytest.approx(20.0, abs=5 * fit.standard_errors["omega"])
    assert fit.gap < 1e-6
    assert "10 segments" in str(fit)
    assert not fit.doubts
    assert "The parts do not join" in str(replace(fit, gap=1e-3))
    again = fit.bootstrap(2)
    np.testing.assert_allclose(again.errors[:, 0], fit.standard_errors["omega"], rtol=0.01)
    assert np.all(np.abs(again.estimates - again.truth) < 5 * again.errors)


def test_several_starts_find_the_best_one():
    start = {"omega": Unknown(24.0, lower=0)}
    fit = vm.fit(CHAIN, measured(), start, scheme=SCHEME, macro_dt=DT, starts=12, spread=0.2)
    assert fit.squares.shape == (12,)
    assert fit.values[0] == pytest.approx(20.0, abs=5 * fit.standard_errors["omega"])


def test_coordinates_at_rest_do_not_make_their_units_tiny():
    """Of a point that falls along one axis, but for 1e-9 of its speed; in other units of lengths and masses, too."""
    sizes = []
    for unit, mass in ((1.0, 1.0), (1e3, 1e-3)):
        system = vm.System(vm.ConstantMass([], [mass, mass]), spring, params={"stiffness": np.array(1.0)})
        problem = vm.Problem(system, [], [unit, 0.0])
        unknowns, steps = Unknowns({"stiffness": Unknown(1.0)}), [np.arange(21)]
        shooting = Shooting(lambda _, problem=problem: problem, unknowns, [], steps, SCHEME, vm.Solver(), DT, 2)
        sizes.append(shooting.sizes(np.zeros(1), unit * np.array([[0.9, 1e-10, -2.0, 2e-9]])) / unit)
    np.testing.assert_allclose(sizes[0], [1.0, 1e-3, 2.0, 2e-3])  # 1e-3 of the speed, times half a second for positions
    np.testing.assert_allclose(sizes[1], sizes[0])


@pytest.mark.full
def test_constrained_motion_in_one_part_and_in_several():
    problem, scheme = PROBLEMS["tsp"](), vm.fully_implicit(1)
    data = measured(steps=60, sigma=1e-4, problem=problem, dt=0.01, scheme=scheme)
    start = {"gravity": Unknown(9.0, lower=0)}
    for segments in (1, 4):
        fit = vm.fit(problem, data, start, scheme=scheme, macro_dt=0.01, segments=segments)
        assert fit.values[0] == pytest.approx(9.81, abs=5 * fit.standard_errors["gravity"])


def test_what_is_not_determined_is_said():
    fit = vm.fit(
        product, measured(), {"a": Unknown(4.0, lower=0), "b": Unknown(4.9, lower=0)}, scheme=SCHEME, macro_dt=DT
    )
    assert fit.undetermined == ["a combination of a, b"]
    assert float(fit.parameters["a"] * fit.parameters["b"]) == pytest.approx(20.0, abs=0.05)
    assert fit.standard_errors["a"] == np.inf
    assert "does not determine a combination of a, b" in str(fit)

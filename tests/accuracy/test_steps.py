"""Runs of an accuracy: their true errors, the choice as arguments, resonant steps, and requests that nothing can
meet."""

import pickle
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.small_systems import SYSTEMS, no_constraint
from vmri_jax.accuracy import search
from vmri_jax.accuracy.companions import Trial
from vmri_jax.accuracy.families import of_order_2
from vmri_jax.mechanics.driving import Events
from vmri_jax.schemes.composition import stage_scheme
from vmri_jax.stability import linear_model
from vmri_jax.study import reference_solution

LENGTH = 2.0
NUM_SAVES = 16
"""Of runs of every accuracy: they share the programs of a number of micro steps, and the reference."""


@cache
def reference_of(name: str):
    return reference_solution(SYSTEMS[name], LENGTH, num_saves=NUM_SAVES)


QUICK = ("no_constraint", 1e-4), ("slow_alone", 1e-2), ("slow_alone", 1e-7)
"""What runs always: with and without micro steps, errors of every size."""
KINDS = ("no_constraint", "slow_alone", "constraint", "damped", "kinetic_function")


@pytest.mark.parametrize(
    ("name", "accuracy"),
    [
        pytest.param(name, accuracy, marks=() if (name, accuracy) in QUICK else pytest.mark.full)
        for name in KINDS
        for accuracy in (1e-2, 1e-4, 1e-7)
    ],
)
def test_true_error_is_below_the_accuracy(name, accuracy):
    run = vm.simulate(SYSTEMS[name], accuracy=accuracy, t_end=LENGTH, save=vm.Save(number=NUM_SAVES))
    true = reference_of(name).errors(run)[0]
    assert len(run) == NUM_SAVES + 1
    assert true <= accuracy
    assert run.error.largest == pytest.approx(true, rel=0.2)
    again = vm.simulate(SYSTEMS[name], **run.settings.arguments)
    np.testing.assert_array_equal(again.q_f, run.q_f)


def test_a_scheme_of_ones_own_keeps_its_rules():
    told = []
    how = {"accuracy": 1e-4, "t_end": LENGTH, "error": "shares"}
    bar = vm.Save(progress=lambda *call: told.append(call))
    run = vm.simulate(SYSTEMS["no_constraint"], vm.fully_explicit(2), save=bar, **how)
    assert told[0] == ("trial of own, 2 micro, 16 macro steps", 0, 5)
    assert [done for _, done, _ in told] == [*range(len(told))]
    assert run.error.largest <= 1e-4
    assert run.settings.scheme == vm.fully_explicit(2).with_num_micro(run.settings.scheme.num_micro)
    assert "scheme.with_num_micro(" in repr(run)
    assert np.isfinite(run.error.slow).all()


def test_settings_are_kept_by_files_and_pickles(tmp_path):
    problem = SYSTEMS["no_constraint"]
    run = vm.simulate(problem, accuracy=1e-4, t_end=LENGTH)
    run.save(tmp_path / "run.npz")
    for read in (vm.Trajectory.load(tmp_path / "run.npz"), pickle.loads(pickle.dumps(run))):
        assert str(read.settings) == str(run.settings)
        assert read.of(problem).settings is read.settings
        assert read[2:].settings is read.settings
    again = vm.simulate(problem, **read.settings.arguments)
    np.testing.assert_array_equal(again.q_f, run.q_f)


def test_rates_of_potentials_divide_the_micro_steps():
    problem = no_constraint()
    problem = replace(problem, system=problem.system.replace(potentials={4: lambda q_s, q_f, params: jnp.sum(q_f**4)}))
    run = vm.simulate(problem, vm.fully_explicit(4), accuracy=1e-3, t_end=LENGTH)
    assert run.error.largest <= 1e-3
    assert stage_scheme(run.settings.scheme).num_micro % 4 == 0


def test_steps_beside_resonances():
    """A slow kick once in half a turn of the fast oscillator is resonant; a few percent more steps are not."""
    problem, length, family = linear_model(omega=50.0, kappa=25.0), 20.0, of_order_2(vm.fully_explicit)
    trials = search.Search(problem, length)
    trial = trials.trial(replace(family, first=40), 2048)
    assert trial.steps_for(trial.error / 4) == 2 * trial.run.num_steps
    assert trial.steps_for(trial.error / 4, order=1) == 4 * trial.run.num_steps
    resonant = round(length / 0.0625)  # within the window of `vmri_jax.stability.advise`
    beside = trials.beside_resonances(trial, resonant)
    assert resonant < beside < 1.3 * resonant
    assert trials.beside_resonances(trial, beside) == beside


def test_steps_that_miss_the_accuracy_are_not_the_last(monkeypatch):
    """A second trial follows a first one with too few steps."""
    told, predicted = [], Trial.steps_for

    def too_few_at_first(trial, *arguments):
        told.append(trial)
        return predicted(trial, *arguments) // (3 if len(told) == 1 else 1)

    monkeypatch.setattr(Trial, "steps_for", too_few_at_first)
    trials = search.Search(SYSTEMS["no_constraint"], LENGTH)
    trial = trials.accurate(trials.trial(replace(of_order_2(vm.fully_explicit), first=2), 64), 1e-4)
    assert 0 < trial.error <= 1e-4
    assert len(told) == 2


def test_a_later_start_and_a_single_saved_interval():
    problem = SYSTEMS["driven"]
    start = vm.simulate(problem, vm.fully_explicit(8), macro_dt=0.01, t_end=1.0)[-1]
    run = vm.simulate(problem, vm.fully_explicit(8), start, accuracy=1e-3, t_end=2.0, save=vm.Save(number=1))
    assert (len(run), float(run.t[0]), float(run.t[-1])) == (2, 1.0, pytest.approx(2.0))
    fine = vm.simulate(problem, vm.fully_explicit(8), start, macro_dt=0.001, t_end=2.0)
    assert np.abs(run.q_f[-1] - fine.q_f[-1]).max() <= 1e-3


def test_a_motion_without_error():
    """Free flight in steps of 2^-k: no scheme has an error, a third run with other steps says so, and no share is
    divided by."""
    free = vm.Problem(vm.System(vm.ConstantMass([1.0], [1.0])), [0.0], [0.0], [1.0], [1.0])
    hows: tuple[dict[str, Any], ...] = (
        {"accuracy": 1e-3, "t_end": 1.0},
        {"macro_dt": 0.25, "num_steps": 8, "error": True},
    )
    for how in hows:
        assert vm.simulate(free, vm.fully_explicit(4), **how).error.largest < 1e-14  # 3e-15


def wall(q_s, q_f, params):
    """A potential that ends at q = 1."""
    return jnp.sum(jnp.log(1.0 - q_s))


def test_a_motion_that_ends_fails_as_without_an_accuracy():
    falling = vm.Problem(vm.System(vm.ConstantMass([1.0], []), wall), [0.5], [], [1.0], [])
    with pytest.raises(vm.SimulationError) as caught, pytest.warns(vm.AccuracyNotReached):
        vm.simulate(falling, vm.fully_explicit(1), accuracy=1e-3, t_end=2.0)
    assert np.isnan(caught.value.trajectory.q_s[-1]).all()


def test_more_steps_than_there_may_be_are_not_tried(monkeypatch):
    monkeypatch.setattr(search, "MOST_STEPS", 2**12)
    with pytest.warns(vm.AccuracyNotReached, match="its error is"):
        run = vm.simulate(SYSTEMS["slow_alone"], vm.fully_explicit(1, alpha=0.3), accuracy=1e-9, t_end=1.0)
    assert run.settings.num_steps <= 2**12


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"accuracy": 1e-20, "t_end": 1.0}, "round-off of float64"),
        ({"accuracy": -1.0, "t_end": 1.0}, "round-off of float64"),
        ({"accuracy": 50.0, "t_end": 1.0}, "no position moves by more than"),
        ({"accuracy": 1e-3}, "needs t_end"),
        ({"accuracy": 1e-3, "t_end": -1.0}, "it must be later"),
        ({"accuracy": 1e-3, "t_end": 1.0, "macro_dt": 0.1}, "got macro_dt with an accuracy"),
        ({"accuracy": 1e-3, "t_end": 1.0, "save": 2}, "got save=2 with an accuracy"),
        ({"t_end": 1.0, "macro_dt": 0.1}, "scheme is None without an accuracy"),
        ({"accuracy": 1e-3, "t_end": 1.0, "save": vm.Save(every=3)}, "every=3.* with an accuracy"),
        ({"accuracy": 1e-3, "t_end": 1.0, "scheme": vm.fully_explicit}, "give a Scheme"),
        ({"accuracy": 1e-3, "t_end": 1.0, "error": lambda run: "far"}, "returned 'far'"),
    ],
)
def test_refused(arguments, message):
    with pytest.raises(vm.Refused, match=message):
        vm.simulate(SYSTEMS["slow_alone"], **arguments)


@pytest.mark.parametrize(("errors", "order"), [((1e-4, 1e-4 / 2**3), 3.0), ((1e-4, 9e-5), 1.0), ((5e-6, 2e-5), 6.0)])
def test_an_error_that_grows_tells_no_order(errors, order):
    """Beside a resonance the next run took as many steps as an error of order 1 needs."""
    trials = (
        SimpleNamespace(error=error, run=SimpleNamespace(num_steps=steps, order=6))
        for error, steps in zip(errors, (20, 40), strict=True)
    )
    observed = search.Search._observed_order(SimpleNamespace(drives=Events()), *trials)  # pyright: ignore
    assert observed == pytest.approx(order)

"""The search for the cheapest setting: what it promises, refuses, and keeps when it fails; the page of cost, and prices
of functions."""

import dataclasses
from importlib import import_module
from itertools import pairwise

import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.accuracy.test_drives import GAUSS, LENGTH, motion, oscillator
from tests.small_systems import no_constraint
from tests.study.test_convergence import PROBLEM
from vmri_jax.accuracy import search
from vmri_jax.accuracy.families import by_promise
from vmri_jax.running.interrupts import Interrupted
from vmri_jax.study import (
    ReferenceSolution,
    Row,
    WorkPrecision,
    convergence_study,
    cost_report,
    families,
    reference_solution,
    tune,
)
from vmri_jax.study.tuning import NothingReached, bound_of, default_t_end, prices

SHORT_MENU = [family for family in families() if family.name in ("fully explicit", "fully explicit, suzuki4")]


@pytest.fixture(scope="module")
def best():
    return tune(PROBLEM, 1e-5, 1.0, menu=SHORT_MENU)


def test_the_setting_keeps_the_error_at_all_nodes(best):
    run = vm.simulate(PROBLEM, **best.setting.settings.arguments)
    truth = reference_solution(PROBLEM, 1.0, num_saves=len(run) - 1)
    assert truth.errors(run)[0] == pytest.approx(best.setting.error_q, rel=0.1)  # 3 % measured
    assert truth.errors(run)[0] <= 1e-5
    every = best.setting.settings.save_every
    assert (best.macro_dt, best.num_steps) == (pytest.approx(float(run.t[1]) / every), every * (len(run) - 1))


def test_the_front_falls(best):
    front = best.runs.pareto()
    assert all(a.seconds <= b.seconds and a.error_q > b.error_q for a, b in pairwise(front))
    assert front[-1].error_q <= 1e-5


def test_it_prints_the_best_few_and_keeps_all(best, tmp_path, monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)  # that workers of pytest have
    head, *rows, last = str(best).splitlines()
    assert head.split()[:2] == ["scheme", "H"]
    assert len(rows) == min(5, len(best.keeping(1e-5)))
    assert rows[0].startswith(best.setting.scheme)
    assert last.startswith("For an error of 1e-05 take the first: its .scheme, .macro_dt and .num_steps.")
    assert repr(best) == str(best)
    best.to_csv(tmp_path / "runs.csv")
    assert len((tmp_path / "runs.csv").read_text().splitlines()) == 1 + len(best.runs.rows)


def test_the_command_names_the_setting(best):
    command = best.setting.settings.command("my_file.py:spring")
    assert command.startswith("vmri simulate my_file.py:spring --scheme fully-explicit")
    assert f"--steps {best.num_steps}" in command


@pytest.mark.parametrize(("digits", "orders"), [(2, [2, 4, 6, 8, 24]), (8, [8, 6, 4, 24, 2])])
def test_schemes_that_fit_the_error_are_tried_first(digits, orders):
    one_each = [family for family in families() if "slow" not in family.name and "implicit" not in family.name]
    tried = [family.make(family.first).order for family in by_promise(one_each, digits)]
    assert list(dict.fromkeys(tried)) == orders


def test_exhaustive_search_tries_every_num_micro(monkeypatch):
    monkeypatch.setattr(search, "NUM_MICRO", search.NUM_MICRO[:3])
    exhaustive = tune(PROBLEM, 1e-3, 1.0, menu=SHORT_MENU[:1], exhaustive=True)
    assert {row.num_micro for row in exhaustive.runs.rows} == set(search.NUM_MICRO)


def test_the_errors_of_a_driven_system_have_seen_its_force():
    """A pulse of a thousandth of a second; before, errors at ten nodes were compared, by runs that had not seen it."""
    problem = oscillator(GAUSS, 3.3, 1e-3, 400.0)
    best = tune(problem, 1e-3, LENGTH, menu=SHORT_MENU[:1])
    run = vm.simulate(problem, **best.setting.settings.arguments)
    true = np.abs(run.q_s[:, 0] - motion(np.asarray(run.t), problem.system.params)).max()
    assert true <= 1e-3
    assert best.macro_dt < 1e-3


@pytest.mark.parametrize(
    ("error", "t_end", "words"),
    [
        (1e-18, 1.0, "round-off"),
        (float("nan"), 1.0, "error is nan; it must be finite"),
        (1e-4, 0.0, "t_end is 0 after the start"),
        (50.0, 1.0, "tune: error is 50, and no position moves by more than"),
    ],
)
def test_refuses(error, t_end, words):
    with pytest.raises(ValueError, match=words):
        tune(PROBLEM, error, t_end, menu=SHORT_MENU[:1])


def test_nothing_reached_hands_back_the_runs(monkeypatch):
    monkeypatch.setattr(search, "MOST_STEPS", 16)
    with pytest.raises(NothingReached, match=r"no setting reached 1e-09") as caught:
        tune(PROBLEM, 1e-9, 1.0, menu=SHORT_MENU[:1])
    assert caught.value.runs.rows


def test_a_system_that_fails_at_every_step_says_so(monkeypatch):
    def broken(q_s, q_f, params):
        return jnp.sum(jnp.log(-1.0 - q_s**2))

    monkeypatch.setattr(search, "MOST_STEPS", 64)
    system = PROBLEM.system.replace(slow_potential=broken)
    with pytest.raises(vm.SimulationError, match="NON_FINITE"):
        tune(dataclasses.replace(PROBLEM, system=system), 1e-4, 0.1, menu=SHORT_MENU[:1])


def test_ctrl_c_keeps_the_runs(monkeypatch, tmp_path):
    def drawing(*_):
        raise KeyboardInterrupt

    def stopped(self, trials):
        if len(self.seconds) == 1:
            raise KeyboardInterrupt
        self.seconds[trials[0].family.expression] = 1.0

    monkeypatch.setattr(import_module("vmri_jax.study.tuning"), "_write", drawing)
    with pytest.raises(Interrupted) as caught:
        cost_report(PROBLEM, "spring", tmp_path, t_end=1.0, errors=[1e-3], menu=SHORT_MENU[:1])
    assert caught.value.done.rows
    monkeypatch.setattr(search.Search, "measure", stopped)
    with pytest.raises(Interrupted, match="interrupted after") as caught:
        tune(PROBLEM, 1e-3, 1.0, menu=SHORT_MENU)
    assert len(caught.value.done.rows) >= 2


EXACT = ReferenceSolution(np.zeros((2, 4)), np.zeros((2, 4)))
ROW = Row("kicks", 5, 2, 4, 0.1, 1e-3, seconds=2.0, slow_evaluations=4, fast_evaluations=20)


def test_bound_is_the_time_of_the_gradients():
    assert bound_of({"V": 0.1, "W": 0.01}, [ROW]) == ((pytest.approx(4 * 0.1 + 20 * 0.01), 1e-3),)
    assert bound_of({"V": 9.0, "W": 1.0}, [ROW]) == ((2.0, 1e-3),)  # of the run, where a loop of its own is slower


def quartic(q_s, q_f, params):
    return jnp.sum(q_f**4)


def test_tables_list_further_potentials(tmp_path):
    problem = no_constraint()
    problem = dataclasses.replace(problem, system=problem.system.replace(potentials={"bends": quartic, 4: quartic}))
    stage = vm.fully_explicit(8).with_potentials(bends=vm.micro(vm.quadrature.trapezoidal, every=2))
    schemes = {"kicks": stage, "composed": vm.compose(stage, "suzuki4")}
    study = convergence_study(problem, schemes, [0.1], 1.0, num_saves=1, reference=EXACT).work()
    one, five = study.rows
    passes = one.fast_evaluations / (10 * 8)
    assert one.evaluations == {"bends": passes * 10 * 4, 4: passes * 10 * 2}
    assert five.stages == 5
    assert "bends" in str(study)
    assert "V_4" in str(study)
    assert "further gradients" not in str(WorkPrecision((ROW,), EXACT))
    study.to_csv(tmp_path / "runs.csv")
    assert "evaluations of bends" in (tmp_path / "runs.csv").read_text()
    price = prices(problem)
    assert set(price) == {"V", "W", "bends", 4}
    ((seconds, _),) = bound_of(price, [dataclasses.replace(one, seconds=np.inf)])
    assert seconds > one.evaluations["bends"] * price["bends"] > 0


def test_cost_report(tmp_path):
    report = cost_report(PROBLEM, "spring", tmp_path, t_end=1.0, errors=(1e-5, 1e-3), menu=SHORT_MENU)
    text = report.path.read_text()
    assert [answer.error for answer in report.rows] == [1e-3, 1e-5]
    assert "What accuracy costs" in text
    printed = " ".join(str(report).split())  # whatever the width of the terminal
    assert "Runs to t = 1, with the largest errors of the positions on the way." in printed
    large, small = report.reached
    assert small.settings.command("spring") in text.replace("&#34;", '"')
    assert small.error_q <= 1e-5
    assert large.error_q <= 1e-3
    assert large.seconds <= small.seconds
    assert set(report.curves.schemes) == {family.name for family in SHORT_MENU}
    for scheme in report.curves.schemes:  # a curve falls
        assert all(a.error_q > b.error_q for a, b in pairwise(report.curves.curve(scheme)))
    front = [row.seconds for row in report.curves.pareto()]
    assert all(0 < seconds <= row for (seconds, _), row in zip(report.bound, front, strict=True))
    assert {"cost.html", "cost.png", "cost_dark.png", "cost.csv"} <= {path.name for path in tmp_path.iterdir()}
    assert default_t_end(PROBLEM) == pytest.approx(30 * 2 * np.pi / 20, rel=0.1)
    with pytest.raises(ValueError, match="each of errors is -1"):
        cost_report(PROBLEM, "spring", tmp_path, t_end=1.0, errors=(-1.0,))
    at_rest = vm.Problem(vm.System(vm.ConstantMass([1.0], [])), [1.0], [])
    with pytest.raises(ValueError, match=r"positions move by 0\.0e\+00.*at rest"):
        cost_report(at_rest, "mass", tmp_path, t_end=1.0, menu=SHORT_MENU[:1])

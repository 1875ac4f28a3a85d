"""The search for the cheapest setting: what it promises, what it refuses, what it keeps when it fails."""

import dataclasses
import json
from itertools import pairwise

import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.small_systems import driven, moving_constraints
from tests.study.test_convergence import PROBLEM
from vmri_jax.running.interrupts import Interrupted
from vmri_jax.study import (
    Program,
    families,
    reference_solution,
    tune,
    work_precision,
)
from vmri_jax.study.advisor import NothingReached, another_start, first_verified
from vmri_jax.study.search import NUM_MICRO, Search

SHORT_MENU = [family for family in families() if family.name in ("fully explicit", "fully explicit, suzuki4")]


@pytest.fixture(scope="module")
def reference():
    return reference_solution(PROBLEM, 1.0, num_saves=1)


@pytest.fixture(scope="module")
def found(reference):
    return tune(PROBLEM, 1e-5, 1.0, menu=SHORT_MENU, reference=reference)


def test_a_reference_refines_itself_until_it_agrees(reference):
    assert 0 < reference.error_q < 1e-12
    assert reference.num_saves == 1


def test_the_setting_keeps_the_error(found):
    run = vm.simulate(
        PROBLEM.system,
        found.scheme,
        PROBLEM.state(),
        macro_dt=found.macro_dt,
        num_steps=found.num_steps,
        save_every=found.num_steps,
    )
    truth = reference_solution(PROBLEM, 1.0, num_saves=1, num_steps=500)
    assert truth.errors(run)[0] == pytest.approx(found.setting.row.error_q, rel=1e-3)
    assert found.setting.row.error_q <= 1e-5


def test_steps_are_as_few_as_possible(found):
    """Of the scheme that is chosen, the fewest steps that keep the error are known within a tenth; more are taken only if faster."""
    chosen = found.setting.row
    rows = [row for row in found.runs.rows if (row.scheme, row.num_micro) == (chosen.scheme, chosen.num_micro)]
    fewest = min((row for row in rows if row.error_q <= 1e-5), key=lambda row: row.num_steps)
    missed = max(row.num_steps for row in rows if row.num_steps < fewest.num_steps)
    assert fewest.num_steps <= max(missed + 1, 1.1 * missed)
    assert chosen is fewest or chosen.seconds < fewest.seconds


def test_from_another_start_it_keeps_the_error(found):
    assert found.verification.error_q <= 1e-5
    assert 0.2 < found.verification.error_ratio < 5


def test_a_setting_that_misses_from_another_start_is_replaced(reference):
    """A lucky setting, whose error at its start is said to be 0, gets the steps with which it keeps the error from another start."""
    search = Search(PROBLEM, 1.0, SHORT_MENU[:1], reference)
    coarse = search.run(SHORT_MENU[0], 5, 100)
    error = coarse.row.error_q / 3
    lucky = dataclasses.replace(coarse, row=dataclasses.replace(coarse.row, error_q=0.0))
    other = another_start(PROBLEM, 1.0)
    setting, check = first_verified(search, [lucky], error, other, reference_solution(other, 1.0, num_saves=1))
    assert setting.num_steps > 100
    assert setting.num_micro == 5
    assert max(setting.row.error_q, check.error_q) <= error


def test_the_front_falls(found):
    front = found.runs.pareto()
    assert all(a.seconds <= b.seconds and a.error_q > b.error_q for a, b in pairwise(front))
    assert front[-1].error_q <= 1e-5


def test_it_prints_the_best_few_and_keeps_all(found, tmp_path, monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)  # that workers of pytest have
    head, *rows, last = str(found).splitlines()
    assert head.split()[:2] == ["scheme", "H"]
    assert len(rows) == min(5, 1 + len(found.others))
    assert rows[0].startswith(found.setting.row.scheme)
    assert last.startswith("For an error of 1e-05 take the first: its .scheme, .macro_dt and .num_steps. From another")
    assert repr(found) == str(found)
    found.to_csv(tmp_path / "runs.csv")
    assert len((tmp_path / "runs.csv").read_text().splitlines()) == 1 + len(found.runs.rows)
    found.to_json(tmp_path / "runs.json")
    assert json.loads((tmp_path / "runs.json").read_text())["choice"]["num_steps"] == found.num_steps


def test_the_command_names_the_setting(found):
    command = found.setting.command("my_file.py:spring")
    assert command.startswith("vmri simulate my_file.py:spring --scheme fully-explicit")
    assert f"--steps {found.num_steps}" in command


@pytest.mark.parametrize(("digits", "orders"), [(2, [2, 4, 6, 8, 24]), (8, [8, 6, 4, 24, 2])])
def test_schemes_that_fit_the_error_are_tried_first(reference, digits, orders):
    one_each = [family for family in families() if "slow" not in family.name and "implicit" not in family.name]
    search = Search(PROBLEM, 1.0, one_each, reference)
    error = 10.0**-digits * np.abs(reference.q[1] - reference.q[0]).max()
    tried = [family.make(family.first).order for family in search.by_promise(error)]
    assert list(dict.fromkeys(tried)) == orders


def test_exhaustive_search_tries_every_num_micro(reference):
    menu = [SHORT_MENU[0]]
    found = tune(PROBLEM, 1e-3, 1.0, menu=menu, reference=reference, exhaustive=True, verify=False)
    assert {row.num_micro for row in found.runs.rows} == set(NUM_MICRO)


@pytest.mark.parametrize(
    ("error", "t_end", "words"),
    [(1e-18, 1.0, "round-off"), (float("nan"), 1.0, "error is nan; it must be finite"), (1e-4, 0.0, "t_end is 0.0")],
)
def test_refuses(error, t_end, words):
    with pytest.raises(ValueError, match=words):
        tune(PROBLEM, error, t_end)


def test_refuses_what_the_reference_cannot_tell(reference):
    poor = dataclasses.replace(reference, error_q=1e-6)
    with pytest.raises(ValueError, match=r"only good to 1\.0e-06"):
        tune(PROBLEM, 1e-6, 1.0, reference=poor)


def test_nothing_reached_hands_back_the_runs(reference, monkeypatch):
    monkeypatch.setattr("vmri_jax.study.search.MAX_RUN_SECONDS", 0.2)
    wrong = dataclasses.replace(reference, q=reference.q + 1.0)
    with pytest.raises(NothingReached, match=r"no setting reached 0\.0001") as caught:
        tune(PROBLEM, 1e-4, 1.0, menu=SHORT_MENU[:1], reference=wrong, verify=False)
    assert len(caught.value.runs.rows) > 3


def test_a_system_that_fails_at_every_step_says_so():
    def broken(q_s, q_f, params):
        return jnp.sum(jnp.log(-1.0 - q_s**2))

    system = PROBLEM.system.replace(slow_potential=broken)
    with pytest.raises(vm.SimulationError, match="NON_FINITE"):
        tune(dataclasses.replace(PROBLEM, system=system), 1e-4, 0.1)


def test_a_program_is_compiled_once_for_all_numbers_of_steps():
    traced = []

    def spring(q_f, params):
        traced.append(1)
        return jnp.sum(q_f**2)

    problem = dataclasses.replace(PROBLEM, system=PROBLEM.system.replace(fast_potential=spring))
    program = Program(problem, vm.fully_explicit(3), 1.0, num_saves=2)
    program(10)
    before = len(traced)
    program(20)
    assert len(traced) == before
    with pytest.raises(ValueError, match="multiple of 2"):
        program(5)
    direct = vm.simulate(
        problem.system, vm.fully_explicit(3), problem.state(), macro_dt=0.1, num_steps=10, save_every=5
    )
    np.testing.assert_allclose(program(10).q_f, direct.q_f, rtol=1e-12)


def test_work_precision_counts_and_times(reference, tmp_path):
    schemes = {"impulse": vm.fully_explicit(4), "midpoint": vm.fully_implicit(4)}
    study = work_precision(PROBLEM, schemes, 1.0, num_steps=(50, 100), reference=reference, repeats=2)
    impulse, midpoint = study.curve("impulse"), study.curve("midpoint")
    assert (impulse[0].slow_evaluations, impulse[0].fast_evaluations, impulse[0].solves) == (50, 200, 0)
    assert midpoint[1].solves == 100
    assert midpoint[1].fast_evaluations >= 400
    assert all(0 < row.low <= row.seconds <= row.high for row in study.rows)
    assert impulse[0].error_q / impulse[1].error_q == pytest.approx(4, rel=0.2)
    study.to_csv(tmp_path / "study.csv")
    study.to_json(tmp_path / "study.json")
    assert len((tmp_path / "study.csv").read_text().splitlines()) == 5
    labels = {work: study.plot(work=work).axes[0].get_xlabel() for work in ("seconds", "solves")}
    assert labels == {"seconds": "computing time of the run", "solves": "systems of equations solved"}
    with pytest.raises(ValueError, match="schemes is empty"):
        work_precision(PROBLEM, {}, 1.0)
    with pytest.raises(ValueError, match="num_saves = 10"):
        work_precision(PROBLEM, schemes, 1.0, num_steps=(55,), num_saves=10)


def test_ladders_end_by_themselves(reference):
    study = work_precision(PROBLEM, {"high order": vm.galerkin(2, 4)}, 1.0, reference=reference, repeats=1)
    errors = [row.error_q for row in study.curve("high order")]
    assert errors[0] > 1e3 * errors[-1]
    assert len(errors) < 12


def test_another_start_fits_constraints_that_move():
    """Its velocities differ from those of the problem, keep ``G v + dg/dt = 0``, and so are accepted without projection."""
    problem = moving_constraints()
    other = another_start(problem, speed=1.0)
    assert 1e-3 < np.abs(other.v_f - problem.v_f).max() < 0.1
    assert not other.project
    state = other.state()  # refused, or warned of, where a part of the velocities above 1e-6 does not fit
    assert vm.diagnostics.constraint_residual(problem.system, state)[1] < 1e-12
    at_rest = another_start(driven(), speed=2.0)
    assert np.abs(at_rest.v_s).max() > 1e-3


def test_ctrl_c_keeps_the_runs(reference, monkeypatch):
    def stopped(self, settings):
        raise KeyboardInterrupt

    monkeypatch.setattr(Search, "_timed", stopped)
    with pytest.raises(Interrupted, match="interrupted after") as caught:
        tune(PROBLEM, 1e-3, 1.0, menu=SHORT_MENU[:1], reference=reference, verify=False)
    assert len(caught.value.done.rows) > 3

"""Staircases of what schemes reach, prices of functions, and further potentials in the tables."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.small_systems import no_constraint
from vmri_jax.accuracy.families import of_order_2
from vmri_jax.study import reference_solution, work_precision
from vmri_jax.study.cost_report import bound_of
from vmri_jax.study.prices import FAST, REMAINDER, SLOW, prices, shares
from vmri_jax.study.reference_solution import ReferenceSolution
from vmri_jax.study.search import Search
from vmri_jax.study.staircase import (
    COMPOSED,
    INTERVALS,
    MICRO,
    SINGLE,
    Stair,
    confirm,
    confirmed,
    kind_of,
    staircases,
    with_shares,
)
from vmri_jax.study.work import WorkPrecision, WorkRow

ROW = WorkRow("kicks", 1, 2, 4, 0.1, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1.0, 0, 0, 0, 1, "EXPLICIT", "CONVERGED")


def row(num_steps: int, error: float, seconds: float, **changes) -> WorkRow:
    return replace(ROW, num_steps=num_steps, error_q=error, **changes).timed([seconds])


def test_a_lucky_run_counts_with_the_errors_of_smaller_steps():
    rows = [row(10, 1e-2, 1.0), row(20, 1e-7, 2.0), row(40, 1e-3, 4.0), row(80, 1e-4, 8.0)]
    assert [(stair.row.num_steps, stair.error) for stair in confirmed(rows)] == [(10, 1e-2), (20, 1e-3), (40, 1e-3)]
    stairs = staircases(rows)[SINGLE]
    assert [stair.row.num_steps for stair in stairs] == [10, 20]  # 40 steps reach no more than 20 do


def test_a_run_that_nothing_confirms_does_not_count():
    assert confirmed([row(10, 1e-2, 1.0)]) == []
    assert confirmed([row(10, 1e-2, 1.0), row(11, 1e-2, 1.1)]) == []
    assert confirmed([row(10, 1e-2, 1.0), row(20, np.nan, 2.0)]) == []


def test_kinds():
    schemes = {
        SINGLE: vm.fully_explicit(1),
        MICRO: vm.fully_implicit(5),
        COMPOSED: vm.compose(vm.fully_explicit(1), "suzuki4"),
        INTERVALS: vm.galerkin(1, 3),
    }
    problem = no_constraint()
    study = work_precision(problem, schemes, 1.0, num_steps=(10,), reference=EXACT, repeats=1)
    assert [kind_of(row) for row in study.rows] == list(schemes)


EXACT = ReferenceSolution(np.zeros((2, 1)), np.zeros((2, 1)))


def test_confirmed_runs_and_shares_of_a_search():
    """Kicks at the limit of the fast vibration: more micro steps help single steps, and many micro steps leave the slow share."""
    problem = no_constraint()
    kicks = of_order_2(vm.fully_explicit)
    search = Search(problem, 1.0, [kicks], reference_solution(problem, 1.0, num_saves=1))
    single, many = search.run(kicks, 1, 100), search.run(kicks, 20, 100)
    assert not any(staircases(search.rows().rows).values())
    confirm(search)
    assert {s.num_steps for s in search.settings.values()} == {100, 150}
    stairs = with_shares(search, staircases(search.rows().rows))
    assert [stairs[kind][0].row for kind in (SINGLE, MICRO)] == [single.row, many.row]
    assert 0 <= stairs[MICRO][0].fast_share < 0.5 < stairs[SINGLE][0].fast_share <= 1


def test_single_steps_are_tried_beside_micro_steps():
    problem = no_constraint()
    kicks = of_order_2(vm.fully_explicit)
    search = Search(problem, 1.0, [kicks], reference_solution(problem, 1.0, num_saves=1))
    search.run(kicks, 5, 40)
    confirm(search)
    assert {(s.num_micro, s.num_steps) for s in search.settings.values()} == {(5, 40), (5, 60), (1, 200), (1, 300)}


def test_bound_is_that_of_the_prices():
    stairs = {SINGLE: [Stair(ROW, 1e-3)], MICRO: [Stair(replace(ROW, num_micro=10), 1e-3)]}
    bound = bound_of(stairs, {SLOW: 9.0, FAST: 1.0})
    assert bound is not None
    assert bound.factor == pytest.approx((9 + 10) / (10 * 10))
    assert bound_of(stairs, {SLOW: 1.0, FAST: 9.0}) is None
    assert bound_of(stairs, {SLOW: 9.0, FAST: 1.0, "gradient of bends": 1.0}) is None
    assert bound_of({}, {SLOW: 9.0, FAST: 1.0}) is None


# --- further potentials ----------------------------------------------------------------------------------------------
def quartic(q_s, q_f, params):
    return jnp.sum(q_f**4)


def test_tables_list_further_potentials(tmp_path):
    problem = no_constraint()
    problem = replace(problem, system=problem.system.replace(potentials={"bends": quartic, 4: quartic}))
    kicks = vm.quadrature.trapezoidal
    stage = vm.fully_explicit(8).with_potentials(bends=vm.micro(kicks, every=2))
    schemes = {"kicks": stage, "composed": vm.compose(stage, "suzuki4")}
    study = work_precision(problem, schemes, 1.0, num_steps=(10,), reference=EXACT, repeats=1)
    one, five = study.rows
    passes = one.fast_evaluations / (10 * 8)
    assert one.evaluations == {"bends": passes * 10 * 4, 4: passes * 10 * 2}
    assert five.stages == 5
    assert "bends" in str(study)
    assert "V_4" in study.markdown()
    study.to_csv(tmp_path / "runs.csv")
    assert "evaluations of bends" in (tmp_path / "runs.csv").read_text()
    price = prices(problem)
    assert set(price) == {SLOW, FAST, "gradient of bends", "gradient of V_4"}
    parts = shares(price, one)
    assert sum(parts.values()) == pytest.approx(1)
    assert parts["gradient of bends"] > 0
    assert REMAINDER in parts


def test_tables_without_further_potentials_have_no_column_for_them():
    study = WorkPrecision((ROW,), 1.0, EXACT)
    assert "further gradients" not in study.markdown()

"""Cost studies: rows, normalisation, and what is refused."""

import csv

import numpy as np
import pytest

import vmri_jax as vm
from benchmarks.gail2014.cost import CostRow, CostStudy, Curve, cost_study, plot_cost
from tests.test_plots import is_drawn, names_below, y_data


@pytest.fixture(scope="module")
def study():
    chain = vm.systems.fermi_pasta_ulam(2)
    curves = [Curve("auto", chain, (1, 3), 2.0, settled=1), Curve("dense", chain, (1, 3), 2.0)]
    return cost_study("chain", vm.explicit_slow, curves, micro_dt=0.01, repeats=3, min_seconds=0.02)


def test_rows(study):
    assert [(row.method, row.num_micro) for row in study.rows] == [("auto", 1), ("auto", 3), ("dense", 1), ("dense", 3)]
    assert {(row.method, row.solved_by) for row in study.rows} == {("auto", "LINEAR"), ("dense", "EXACT")}
    assert [row.num_unknowns for row in study.rows] == [4, 8, 4, 8]
    assert all(row.result == "CONVERGED" for row in study.rows)
    assert [row.iterations >= 1 for row in study.rows] == [False, False, True, True]
    assert [row.num_steps for row in study.rows] == [200, 67, 200, 67]


def test_times_are_per_simulated_unit_and_per_micro_step(study):
    for row in study.rows:
        assert 0.01 < row.us_per_micro_step < 1e4
        assert row.seconds_per_unit == pytest.approx(row.us_per_micro_step * 1e-6 / 0.01)
        assert row.first_call_seconds > 0
        assert np.isfinite(row.us_in_short_step) == (row.method == "auto" and row.num_micro == 3)


def test_curves_and_sums(study):
    num_micro, cost = study.curve("chain", "dense")
    assert num_micro.tolist() == [1, 3]
    assert cost.tolist() == [row.us_per_micro_step for row in study.rows[2:]]
    assert (study + study).rows == study.rows * 2
    with pytest.raises(ValueError, match=r"no .*'chain', 'sparse'"):
        study.curve("chain", "sparse")


def test_csv(study, tmp_path):
    study.to_csv(tmp_path / "cost.csv")
    with open(tmp_path / "cost.csv", newline="") as file:
        lines = list(csv.DictReader(file))
    assert [int(line["num_unknowns"]) for line in lines] == [4, 8, 4, 8]
    assert float(lines[-1]["us_per_micro_step"]) == study.rows[-1].us_per_micro_step


def test_a_run_that_fails_has_no_time():
    problem = vm.systems.fermi_pasta_ulam(2, omega=1e9)
    study = cost_study("", vm.fully_explicit, [Curve("exact", problem, (2,), 40.0)], micro_dt=1.0, repeats=1)
    (row,) = study.rows
    assert row.result == "NON_FINITE"
    assert np.isnan(row.us_per_micro_step)


def cost(costs=(9.0, 3.0, 6.0), solver="dense"):
    rows = [
        CostRow("FPU", solver, n, 3 * n, 10, 1.0, value, 1.0, 2, "EXACT", "CONVERGED")
        for n, value in zip((1, 10, 100), costs, strict=True)
    ]
    return CostStudy(tuple(rows))


def test_cost_circles_the_minimum_and_marks_the_paper():
    figure = plot_cost({"FPU": cost() + cost((5.0, 4.0, 3.0), "exact")}, {"FPU": 60})
    lines = figure.axes[0].lines
    circled = [np.asarray(line.get_xydata()).tolist() for line in lines if line.get_markersize() == 11]
    assert circled == [[[10.0, 3.0]], [[100.0, 3.0]]]
    assert names_below(figure) == ["dense", "exact", "minimum in the paper"]
    assert np.asarray(lines[-1].get_xdata()).tolist() == [60, 60]


def test_a_cost_study_draws_itself():
    (axes,) = (figure := plot_cost({"": cost() + cost((5.0, 4.0, 3.0), "auto")})).axes
    assert names_below(figure) == ["dense", "auto"]
    np.testing.assert_array_equal(y_data(axes.lines[0]), [9.0, 3.0, 6.0])


def test_an_axis_of_costs_around_one_power_of_ten_has_several_labels():
    figure = plot_cost({"FPU": cost((1.5, 2.5, 75.0))})
    figure.canvas.draw()
    low, high = figure.axes[0].get_ylim()
    labels = figure.axes[0].get_yticklabels()
    shown = [text.get_text() for text in labels if low <= text.get_position()[1] <= high]
    assert shown == ["2", "5", "10", "20", "50"]


def test_cost_leaves_failed_runs_out():
    figure = plot_cost({"FPU": cost((np.nan, np.nan, np.nan))})
    assert len(figure.axes[0].lines) == 1


def test_costs_of_runs_that_all_failed_are_drawn():
    row = CostRow("", "dense", 2, 8, 4, np.nan, np.nan, 1.0, 1, "EXACT", "NON_FINITE")
    assert is_drawn(plot_cost({"failed": CostStudy((row,))}))

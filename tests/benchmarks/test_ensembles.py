"""Benchmarks of ensembles: tiny ones run, figures are drawn."""

import numpy as np
import pytest

from benchmarks import ensembles

xarray = pytest.importorskip("xarray")


def test_many_runs(tmp_path):
    report = ensembles.million(ensembles.Size((), 1, 1, 2000, 2, 2), "quick", tmp_path, lambda _: None)
    (row,) = report.rows
    assert row["lanes"] == 2000
    assert row["MB on disk"] == pytest.approx(0.22, abs=0.05)  # 104 bytes a run, and metadata
    assert 0 < row["RSS MB at a third"] < 2 * row["RSS MB at the end"]


def test_the_study_has_a_panel_for_each_scheme_and_number_of_micro_steps():
    axes = {"scheme": ["a", "b"], "num_micro": [1, 5], "num_steps": [4000, 400, 40], "omega": np.geomspace(10, 1000, 6)}
    error = xarray.DataArray(np.geomspace(1e-7, 10, 72).reshape(2, 2, 3, 6), coords=axes, dims=list(axes))
    figure = ensembles._draw_study(error.where(error < 1), ensembles.plots.LIGHT)
    assert [panel.get_title(loc="left") for panel in figure.axes[:2]] == ["num_micro = 1", "num_micro = 5"]
    assert len(figure.axes) == 5  # and the bar of colours


@pytest.mark.full
def test_speed(tmp_path):
    report = ensembles.speed(ensembles.Size((), 1, 1, 0, 0, 0), "quick", tmp_path, lambda _: None)
    assert [row["what"] for row in report.rows] == ["simulate_batch", "this process", "1 worker", "2 workers"]

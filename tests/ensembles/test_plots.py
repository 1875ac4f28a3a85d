"""Figures of ensembles: what is drawn, and what is refused."""

from typing import Any

import numpy as np
import pytest

import vmri_jax as vm
from tests.ensembles.own import put
from vmri_jax import plots
from vmri_jax.ensembles import Axis, Draws

xarray = pytest.importorskip("xarray")


@pytest.fixture(scope="module")
def grid(tmp_path_factory):
    """Three axes; some runs fail."""
    axes = {"num_micro": [1, 3], "omega": Axis([20.0, 50.0, 1e9], "rad/s"), "v_s[0]": [0.0, 0.1, 0.2, 0.3]}
    out = tmp_path_factory.mktemp("grid") / "runs.zarr"
    how = {"vary": put, "t_end": 1.0, "macro_dt": 0.05, "save": ("nodes", "extremes", "energy_error"), "num_saves": 5}
    return vm.ensemble("fpu", "fully-explicit", axes, **how, out=out).open()


@pytest.fixture(scope="module")
def cloud(tmp_path_factory):
    design = Draws(50, {"omega": ("uniform", 20, 60), "v_s[0]": ("normal", 0, 0.1)})
    out = tmp_path_factory.mktemp("cloud") / "runs.zarr"
    how = {"vary": put, "t_end": 1.0, "macro_dt": 0.05, "save": "energy_error", "num_saves": 5}
    return vm.ensemble("fpu", "fully-explicit", design, num_micro=2, **how, out=out).open()


def test_the_status_is_drawn_only_if_it_is_asked_for(grid):
    kept = grid[["result", "failed_at", "node_q_s", "node_t"]]
    with pytest.raises(ValueError, match=r"no quantity is one number per run; there are node_q_s\. Save one"):
        plots.plot_ensemble(kept)
    assert plots.plot_ensemble(kept, "result").axes[-1].get_ylabel() == "result"
    assert plots.plot_ensemble(grid[["result", "node_energy", "node_t"]]).axes[0].get_title(loc="left") == "node_energy"


def test_a_map_has_a_panel_for_each_value_of_the_third_axis(grid):
    figure = plots.plot_ensemble(grid, title="map")
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles[:2] == ["num_micro = 1", "num_micro = 3"]
    assert figure.axes[0].get_xlabel() == "v_s[0]"
    assert figure.axes[0].get_ylabel() == "omega in rad/s"
    assert any("failed" in text.get_text() for text in figure.texts)


def panel(*arguments) -> Any:
    """The first panel of a figure."""
    return plots.plot_ensemble(*arguments).axes[0]


def names(axes) -> list[str]:
    """What is in its legend."""
    return [text.get_text() for text in axes.get_legend().get_texts()]


def test_curves_bands_points_and_counts(grid, cloud):
    few = grid.isel(omega=0)
    curves = panel(few, "energy_error", "v_s[0]")
    assert names(curves) == ["num_micro = 1", "num_micro = 3"]
    assert np.allclose(curves.lines[0].get_ydata(), few.energy_error.isel(num_micro=0))
    assert "median" in names(panel(grid.isel(omega=[0, 1] * 2), "energy_error", "v_s[0]"))
    assert panel(cloud, "energy_error", "omega").collections[0].get_offsets().shape == (50, 2)
    coloured = panel(cloud, "energy_error", "omega", "v_s[0]").collections[0]
    assert np.allclose(coloured.get_array(), cloud.energy_error)
    assert sum(bar.get_height() for bar in panel(cloud).patches) == 50


def test_trajectories_have_bands_of_runs_that_did_not_fail(grid):
    figure = plots.plot_ensemble(grid, "node_q_s", theme=plots.DARK)
    assert [axes.get_title(loc="left") for axes in figure.axes] == [f"centres[{i}]" for i in range(3)]
    middle = figure.axes[0].lines[0].get_ydata()
    good = grid.node_q_s.isel(slow=0).where(grid.result <= 1).median(("num_micro", "omega", "v_s[0]"))
    assert np.allclose(middle, good)


def test_the_legend_of_one_panel_of_bands_is_inside_the_figure(grid):
    figure = plots.plot_ensemble(grid, "node_energy")
    figure.draw_without_rendering()
    box, page = figure.legends[0].get_window_extent(), figure.bbox
    assert page.x0 <= box.x0 <= box.x1 <= page.x1
    assert page.y0 <= box.y0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("enrgy",), "there is no quantity 'enrgy'"),
        (("max_q_s",), r"several numbers per run; choose one, data\.isel\(slow=0\)"),
        (("energy_error", "omga"), "there is no axis or column 'omga'"),
    ],
)
def test_bad_names_are_refused(grid, arguments, message):
    with pytest.raises(ValueError, match=message):
        plots.plot_ensemble(grid, *arguments)

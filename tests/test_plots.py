"""Figures: what is drawn, and that nothing outside the figure is touched."""

import dataclasses
from io import BytesIO
from pathlib import Path

import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest

import vmri_jax as vm
from tests.animation.support import trajectory
from tests.support import set_up
from vmri_jax import plots
from vmri_jax.accuracy.companions import resting
from vmri_jax.mechanics.names import Names
from vmri_jax.running.origin import Origin
from vmri_jax.running.simulation import simulation
from vmri_jax.study import ConvergenceStudy, CostReport, ReferenceSolution, Row, WorkPrecision


def run(num_nodes=21, n_s=2, n_f=3, constrained=False):
    """A trajectory without a simulation."""
    t = np.linspace(0.0, 1.0, num_nodes)

    def wave(n):
        return np.sin(t[:, None] * np.arange(1, n + 1))

    residual = np.full((num_nodes, 2), 1e-14 if constrained else 0.0)
    return trajectory(t, wave(n_s), wave(n_f), energy=2.0 + 1e-3 * np.sin(t), constraint_residual=residual)


def study(orders=(1, 2)):
    """A convergence study of exact orders."""
    rows = [
        Row(f"order {order}", 5, order, round(1 / dt), dt, dt**order, 10 * dt**order)
        for order in orders
        for dt in (0.1, 0.01, 0.001)
    ]
    return ConvergenceStudy(tuple(rows), {"": ReferenceSolution(np.zeros((2, 1)), np.zeros((2, 1)))})


def labels(axes):
    return [text.get_text() for text in axes.get_legend().get_texts()]


def names_below(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def look(line):
    return line.get_color(), line.get_marker(), line.get_linestyle()


def y_data(line):
    return np.asarray(line.get_ydata(), dtype=float)


def test_a_trajectory_has_a_panel_for_everything_it_carries():
    free, held = plots.plot_trajectory(run()), plots.plot_trajectory(run(constrained=True))
    assert [len(figure.axes) for figure in (free, held)] == [3, 4]
    assert labels(free.axes[0]) == ["q_s[0]", "q_s[1]"]
    assert "E_0" in free.axes[2].get_ylabel()
    np.testing.assert_allclose(y_data(free.axes[2].lines[0]), 0.5e-3 * np.sin(run().t), atol=1e-15)


def test_a_trajectory_cut_short_by_a_failure_is_drawn_up_to_there():
    whole = run(constrained=True)
    cut = whole.with_arrays(q_s=jnp.asarray(whole.q_s).at[5:].set(jnp.nan))
    drawn = y_data(plots.plot_trajectory(cut).axes[0].lines[0])
    assert np.isfinite(drawn).sum() == 5


def test_of_many_coordinates_some_are_named():
    axes = plots.plot_trajectory(run(n_f=40)).axes[1]
    assert len(axes.lines) == 40
    legend = axes.get_legend()
    assert legend is not None
    assert legend.get_title().get_text() == "12 of 40"
    assert labels(axes)[:2] == ["q_f[0]", "q_f[4]"]
    assert labels(axes)[-1] == "q_f[39]"


def test_bodies_give_their_names():
    names = Names(slow={"cart": 1, "beam": 1}, fast={"bob": 3})
    axes = plots.plot_trajectory(dataclasses.replace(run(), origin=Origin(names))).axes
    assert labels(axes[0]) == ["cart", "beam"]
    assert labels(axes[1]) == ["bob x", "bob y", "bob z"]


def test_the_energy_of_a_driven_system_has_a_balance():
    def drag(t, q_s, q_f, v_s, v_f, params):
        return -0.5 * v_s, jnp.zeros(0)

    def spring(q_s, q_f, params):
        return 2.0 * q_s @ q_s

    problem = vm.Problem(vm.System(vm.ConstantMass([1.0], []), spring, force=drag), [1.0], [], [0.0], [])
    damped = vm.simulate(problem, vm.fully_implicit(1), macro_dt=0.01, num_steps=200)
    axes = plots.plot_trajectory(damped).axes
    assert [a.get_ylabel() for a in axes] == ["slow positions $q_s$", "energy and work", "energy balance"]
    assert labels(axes[1]) == ["energy", "work of forces"]
    assert np.abs(y_data(axes[2].lines[0])).max() < 1e-3 * np.abs(y_data(axes[1].lines[0])).max()
    free = dataclasses.replace(problem, system=problem.system.replace(force=None))
    kept = resting(set_up(free, vm.fully_implicit(1), 0.01, 20))
    for shown, label in ((kept, "energy error"), (dataclasses.replace(kept, origin=Origin()), "energy change")):
        assert plots.plot_trajectory(shown).axes[1].get_ylabel().startswith(label)


def test_convergence_names_the_orders_and_draws_guides_only_where_asked():
    figure = plots.plot_convergence(study(), orders=(2,))
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["positions", "momenta"]
    assert names_below(figure) == ["order 1   order 1.00 (q), 1.00 (p)", "order 2   order 2.00 (q), 2.00 (p)"]
    assert [len(axes.patches) for axes in figure.axes] == [1, 1]
    corners = np.asarray(figure.axes[0].patches[0].get_path().vertices, dtype=float)
    slope = np.log(corners[2, 1] / corners[1, 1]) / np.log(corners[1, 0] / corners[0, 0])
    assert slope == pytest.approx(2.0, abs=1e-12)


def test_convergence_says_when_a_scheme_failed():
    rows = [dataclasses.replace(row, error_q=np.nan, error_p=np.nan) for row in study((1,)).rows]
    figure = plots.plot_convergence(dataclasses.replace(study(), rows=tuple(rows)), orders=(1,))
    assert names_below(figure) == ["order 1   failed"]


@pytest.mark.parametrize("theme", [plots.LIGHT, plots.DARK])
def test_thirty_curves_look_different(theme):
    for axes in plots.plot_convergence(study(range(1, 31)), theme=theme).axes:
        assert len({look(line) for line in axes.lines}) == 30
    looks = [plots.curve_look(i, theme) for i in range(30)]
    assert len({(look["color"], look["linestyle"]) for look in looks}) == 30  # markers may hide each other


def test_the_legend_of_many_curves_is_inside_the_figure_and_leaves_the_panels_their_height():
    few, many = plots.plot_convergence(study()), plots.plot_convergence(study(range(1, 16)))
    heights = []
    for figure, count in ((few, 2), (many, 15)):
        figure.draw_without_rendering()
        legend = figure.legends[0]
        assert len(legend.get_texts()) == count
        box, page = legend.get_window_extent(), figure.bbox
        assert page.x0 <= box.x0 <= box.x1 <= page.x1
        assert page.y0 <= box.y0
        panels = [axes.get_tightbbox() for axes in figure.axes]
        assert all(panel is not None and panel.y0 >= box.y1 for panel in panels)
        heights.append(figure.axes[0].get_window_extent().height)
    assert heights[1] == pytest.approx(heights[0], rel=0.1)  # measured: 0.015 more


def test_residuals_are_not_drawn_below_roundoff():
    residual = np.full((21, 2), 1e-15)
    residual[3], residual[7] = 0.0, 1e-33
    axes = plots.plot_trajectory(dataclasses.replace(run(), constraint_residual=residual)).axes[-1]
    for line in axes.lines:
        assert np.flatnonzero(y_data(line) == 1e-17).tolist() == [3, 7]
    assert 1e-18 < axes.get_ylim()[0] <= 1e-17


@pytest.mark.parametrize("ending", ["png", "svg", "pdf"])
def test_figures_are_saved_in_their_own_colours(tmp_path, ending):
    path = tmp_path / f"figure.{ending}"
    plots.save(plots.plot_trajectory(run(), "title", plots.DARK), path, plots.DARK)
    assert path.stat().st_size > 1000
    if ending == "svg":
        assert plots.DARK.paper in path.read_text()


def test_notebooks_show_figures():
    assert plots.plot_trajectory(run())._repr_png_().startswith(b"\x89PNG")


def test_short_sweeps_have_readable_steps():
    rows = [row for row in study().rows if row.macro_dt > 0.005]
    short = plots.plot_convergence(dataclasses.replace(study(), rows=tuple(rows)))
    short.canvas.draw()
    ticks = [text.get_text() for text in short.axes[0].get_xticklabels()]
    assert {"0.01", "0.02", "0.05", "0.1"} <= set(ticks)


def test_global_settings_stay_as_they_were():
    before = dict(matplotlib.rcParams)
    plots.plot_convergence(study())
    assert dict(matplotlib.rcParams) == before


# --- nothing to show
# ---------------------------------------------------------------------------------------------------

EXACT = ReferenceSolution(np.zeros((2, 2)), np.zeros((2, 2)))


def work_row(error: float, seconds: float = 1e-3) -> Row:
    """A run with this error and time."""
    return Row("impulse", 2, 2, 4, 0.1, error, error, seconds=seconds)


@pytest.mark.parametrize(
    "errors", [(), (0.0, 0.0), (np.nan, np.nan), (0.0, 1e-3)], ids=["none", "zero", "failed", "one"]
)
@pytest.mark.parametrize("work", ["seconds", "solves"])
def test_runs_without_a_positive_error_or_work_are_drawn(errors, work):
    study = WorkPrecision(tuple(map(work_row, errors)), EXACT)
    assert is_drawn(study.plot(work=work))


@pytest.mark.parametrize("errors", [(0.0, 0.0), (np.nan, np.nan)], ids=["zero", "failed"])
def test_convergence_without_a_positive_error_is_drawn(errors):
    steps = zip((1, 2), errors, strict=True)
    rows = tuple(Row("impulse", 2, 2, n, 0.1 / n, error, error) for n, error in steps)
    assert is_drawn(ConvergenceStudy(rows, {"": EXACT}).plot("errors", [2]))


@pytest.mark.parametrize("count", [0, 1])
@pytest.mark.parametrize("error", [0.0, 1e-3])
def test_the_figure_of_a_cost_page_is_drawn_whatever_it_holds(count, error):
    """The page is drawn where a search ends early, with whatever it has."""
    rows = (work_row(error),) * count
    bound = tuple((row.seconds / 2, row.error_q) for row in rows)
    runs = WorkPrecision(rows)
    assert is_drawn(CostReport(Path("cost.html"), "", 1.0, (1e-2, 1e-4), runs, bound).figure("title", plots.DARK))


def test_a_single_node_and_a_run_that_failed_at_once_are_drawn():
    nodes = run(constrained=True)
    assert is_drawn(nodes[0:1].plot())
    names = "t", "q_s", "q_f", "energy", "constraint_residual"
    nothing = {name: np.full(np.shape(getattr(nodes, name)), np.nan) for name in names}
    assert is_drawn(nodes.with_arrays(**nothing).plot())


def is_drawn(figure) -> bool:
    """Whether matplotlib draws it, without a warning."""
    file = BytesIO()
    figure.savefig(file, format="svg")
    return file.tell() > 1000


# --- scenes in joint coordinates
# ---------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def sliding_door():
    """A cart on a rail with a door on a hinge, at rest at its start; nothing is computed."""
    cart = vm.scene.RigidBody("cart", 2.0, vm.scene.Box((1.0, 1.0, 1.0)), [0.0, 0.0, 0.0])
    door = vm.scene.RigidBody("door", 1.0, vm.scene.Box((1.0, 0.1, 1.0)), [1.0, 0.0, 0.0])
    rail = vm.scene.Prismatic(("ground", "cart"), at=[0.0, 0.0, 0.0], axis=[1.0, 0.0, 0.0], name="rail")
    hinge = vm.scene.Revolute(("cart", "door"), at=[0.5, 0.0, 0.0], axis=[0.0, 0.0, 1.0], name="hinge")
    scene = vm.scene.Scene([cart, door], [rail, hinge])
    return resting(simulation(scene, vm.fully_implicit(1), None, None, 0.1, num_steps=4))


def test_angles_and_lengths_have_panels_of_their_own(sliding_door):
    curves = {a.get_ylabel(): [line.get_label() for line in a.lines] for a in sliding_door.plot().axes}
    angles, lengths = ([curves[name] for name in curves if unit in name] for unit in ("rad", "positions"))
    assert angles == [["hinge"]]
    assert lengths == [["rail"]]


def test_forces_have_units_and_name_the_joints_without_curves(sliding_door, monkeypatch):
    forces = {"stop": {"hinge": np.ones((5, 1)), "rail": np.ones((5, 1))}}
    monkeypatch.setattr(vm.Trajectory, "reaction_forces", lambda run: forces)
    figure = sliding_door.plot_forces()
    labels = ["reaction force\nN in SI units", "torque on angles\nN m in SI units"]
    assert [axes.get_ylabel() for axes in figure.axes] == labels
    assert "by_directors" in figure.get_supxlabel()

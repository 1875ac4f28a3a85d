"""Every system through what makes runs and what looks at one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.tools.table import MACRO_DT, SCHEME, STEPS, Cell, cells, check
from vmri_jax import animation, plots
from vmri_jax.scene import Scene

STEPPING = {"macro_dt": MACRO_DT, "num_steps": STEPS}


def simulate(cell: Cell) -> None:
    assert cell.run.success
    assert "CONVERGED" in str(cell.run) or "EXPLICIT" in str(cell.run)


def prepare(cell: Cell) -> None:
    run = vm.prepare(cell.moving, SCHEME, **STEPPING)()
    np.testing.assert_allclose(run.q_s, cell.run.q_s, rtol=0, atol=1e-13)
    np.testing.assert_allclose(run.q_f, cell.run.q_f, rtol=0, atol=1e-13)


def simulate_batch(cell: Cell) -> None:
    states = jax.tree.map(lambda a: jnp.stack([jnp.asarray(a)] * 2), cell.problem.state())
    batch = vm.simulate_batch(cell.problem.system, SCHEME, states, **STEPPING)
    np.testing.assert_allclose(batch.q_s[1], cell.run.q_s, rtol=0, atol=1e-12)
    np.testing.assert_allclose(batch.q_f[1], cell.run.q_f, rtol=0, atol=1e-12)


def stream(cell: Cell) -> None:
    stored = vm.stream(cell.moving, SCHEME, **STEPPING, out=cell.folder / "run.zarr", chunk=STEPS // 2)
    assert stored.success
    np.testing.assert_allclose(stored.load().q_f, cell.run.q_f, rtol=0, atol=1e-12)
    assert str(stored)


def ensemble(cell: Cell) -> None:
    steps = {"macro_dt": [MACRO_DT, MACRO_DT / 2]}
    kept = {"out": cell.folder / "runs.zarr", "save": ["end", "energy_error"], "num_saves": STEPS}
    runs = vm.ensemble(cell.moving, SCHEME, steps, num_steps=STEPS, **kept)
    assert runs.complete
    assert not runs.failed_runs
    plots.plot_ensemble(runs.open())


def plot(cell: Cell) -> None:
    plots.save(cell.run.plot("a run"), cell.folder / "run.png")
    cell.run[0:1].plot()


def export(cell: Cell) -> None:
    run, folder = cell.run, cell.folder
    run.to_csv(folder / "run.csv")
    run.to_parquet(folder / "run.parquet")
    assert len(run.to_pandas()) == STEPS + 1
    assert run.to_xarray().sizes["t"] == STEPS + 1
    run.save(folder / "run.npz")
    np.testing.assert_array_equal(vm.Trajectory.load(folder / "run.npz").energy, run.energy)
    for quantity in (run.v_s, run.v_f, run.work(), run.multipliers(), run.final_state):
        assert str(quantity)


def animate(cell: Cell) -> None:
    run, folder = cell.run, cell.folder
    drawing = animation.Drawing.from_dict(cell.problem.drawing or animation.bars(run))
    motion = animation.motion(run, drawing, cell.problem.system)
    animation.write_html(motion, folder / "run.html", cell.system)
    animation.write_gif(motion, folder / "run.gif", 0.1, plots.LIGHT)
    animation.write_vtk(motion, folder / "run.pvd")
    plots.save(animation.plot_strip(motion, 2, cell.system, plots.LIGHT), folder / "run.png")


def describe(cell: Cell) -> None:
    assert str(vm.plan(cell.problem.system, SCHEME, cell.problem.state()))
    assert str(cell.moving)
    assert str(cell.problem)
    if isinstance(cell.moving, Scene):
        assert str(cell.moving.explain(SCHEME, measure=False))


def shadow_energy(cell: Cell) -> None:
    shadow = vm.diagnostics.shadow_energy(cell.moving, SCHEME, cell.run, k=1)
    assert np.isfinite(shadow.band)
    assert str(shadow)


TOOLS = {
    tool.__name__: tool
    for tool in (simulate, prepare, simulate_batch, stream, ensemble, plot, export, animate, describe, shadow_energy)
}
REFUSED = {
    ("shadow_energy", "moving_constraints"): "constraints that depend on time: no energy is kept",
    ("shadow_energy", "damped"): "forces: no energy is kept",
    ("shadow_energy", "driven"): "forces: no energy is kept",
}


@cells(TOOLS)
def test_cell(tool: str, system: str, tmp_path, monkeypatch: pytest.MonkeyPatch):
    check(TOOLS, REFUSED, tool, Cell(system, tmp_path, monkeypatch))

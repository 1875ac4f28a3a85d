"""Every system through what differentiates runs: gradients, fits, controls."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.small_systems import SYSTEMS
from tests.tools.table import MACRO_DT, SCHEME, Cell, cells, check
from vmri_jax import control, fitting, plots
from vmri_jax.scene import Scene

STEPS = 2


def _first(cell: Cell) -> vm.Solver:
    """Without the fallback, whose derivative takes as long to compile again, where there is one."""
    return vm.plan(cell.problem, SCHEME).first


def gradient(cell: Cell) -> None:
    problem, state = cell.problem, cell.problem.state()

    def distance(part):
        start = vm.State(state.t, state.q_s, state.q_f, part * state.p_s, part * state.p_f)
        run = vm.simulate(problem.system, SCHEME, start, macro_dt=MACRO_DT, num_steps=STEPS, solver=_first(cell))
        return jnp.sum(run.q_s[-1] ** 2) + jnp.sum(run.q_f[-1] ** 2)

    assert np.isfinite(jax.grad(distance)(1.0))


def fit(cell: Cell) -> None:
    run = cell.run[: STEPS + 1]
    seen = np.concatenate([run.q_s, run.q_f], axis=1)[1:]
    data = fitting.Measured(run.t[1:], seen, 1e-6, lambda state: jnp.concatenate([state.q_s, state.q_f]))
    known = cell.problem.system.params
    model: Any = cell.problem
    if isinstance(cell.moving, Scene):
        effect, name = ("springs", "stiffness") if "springs" in known else ("gravity", "acceleration")
        right = float(known[effect][name])

        def with_number(values):
            params = known | {effect: known[effect] | {name: values[name]}}
            return replace(cell.problem, system=cell.problem.system.replace(params=params))

        model = with_number
    else:
        name = "soft" if run.q_s.size else "stiff"
        right = float(known[name])
    found = vm.fit(model, data, {name: 1.1 * right}, scheme=SCHEME, macro_dt=MACRO_DT)
    assert found.parameters[name] == pytest.approx(right, rel=1e-5)
    assert str(found)
    plots.plot_fit(found)


def push(q_s, q_f, u, params):
    return u[0] * jnp.ones_like(q_s), u[0] * jnp.ones_like(q_f)


def effort(state, u):
    return u @ u / 2 + jnp.sum(state.q_s**2) + jnp.sum(state.q_f**2)


STEPPING = {"scheme": SCHEME, "macro_dt": MACRO_DT, "num_steps": STEPS}


def minimize(cell: Cell) -> None:
    best = control.minimize(cell.problem, effort, actuate=push, num_controls=1, solver=_first(cell), **STEPPING)
    assert best.success
    assert str(best)
    plots.save(plots.plot_control(best), cell.folder / "controls.png")


def minimize_without_controls(cell: Cell) -> None:
    control.minimize(cell.moving, effort, **STEPPING)


TOOLS = {tool.__name__: tool for tool in (gradient, fit, minimize, minimize_without_controls)}
REFUSED = {("minimize_without_controls", system): "minimize" for system in SYSTEMS}
DEAR = {"fit": ("one_coordinate", "fast_alone"), "minimize": ("one_coordinate", "fast_alone")}
FULL = {(tool, system) for tool, quick in DEAR.items() for system in SYSTEMS if system not in quick}
"""A fit compiles the Jacobian of a whole run and a search, controls the derivatives of steps, a search and a roll-out:
7 to 12 s of processor time for one coordinate, 30 s for a scene."""


@cells(TOOLS, FULL)
def test_cell(tool: str, system: str, tmp_path, monkeypatch: pytest.MonkeyPatch):
    check(TOOLS, REFUSED, tool, Cell(system, tmp_path, monkeypatch))

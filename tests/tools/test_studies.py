"""Every system through the studies of accuracy and cost, what linearises it, and the hard cases of `vmri check`.

`tune`, `cost_report`, `advise` and `stability_map` are run by the commands `tune`, `cost`, `advise` and `stability`.
"""

import numpy as np
import pytest

from tests.small_systems import SYSTEMS
from tests.tools.table import MACRO_DT, SCHEME, T_END, Cell, cells, check
from vmri_jax import diagnostics, plots, stability, study
from vmri_jax.hard_cases import cases_for, run_cases


def reference_solution(cell: Cell) -> None:
    assert cell.reference.error_q < 1e-5


def convergence_study(cell: Cell) -> None:
    rows = study.convergence_study(
        cell.moving, {"explicit": SCHEME}, [MACRO_DT, MACRO_DT / 2], T_END, num_saves=1, reference=cell.reference
    )
    assert all(np.isfinite(row.error_q) for row in rows.rows)
    assert str(rows)
    plots.save(rows.plot("orders", [2]), cell.folder / "orders.png")
    rows.to_csv(cell.folder / "orders.csv")
    rows.to_xarray()


def work_and_precision(cell: Cell) -> None:
    rows = study.convergence_study(
        cell.moving, {"explicit": SCHEME}, [MACRO_DT], T_END, num_saves=1, reference=cell.reference, repeats=1
    ).work()
    assert all(np.isfinite(row.error_q) for row in rows.rows)
    assert str(rows)
    for work in ("seconds", "solves", "fast_evaluations"):
        plots.save(rows.plot(work=work), cell.folder / "work.png")


def monodromy(cell: Cell) -> None:
    product = stability.monodromy(cell.moving, SCHEME, macro_dt=MACRO_DT, num_steps=2)
    assert str(product)


def linearise(cell: Cell) -> None:
    linear = diagnostics.linearise(cell.moving)
    assert str(linear)
    assert np.isfinite(linear.frequencies).all()
    assert (np.diff(linear.frequencies) <= 0).all()
    assert linear.kinetic_shares.sum(axis=0) == pytest.approx(1.0)


def two_cases(cell: Cell) -> None:
    """Tiny steps and reductions, which compile little."""
    report = run_cases(cases_for(cell.moving), (6, 9))
    assert report.passed, str(report)


def all_cases(cell: Cell) -> None:
    report = run_cases(cases_for(cell.moving))
    assert report.passed, str(report)
    assert (cell.folder / "cases.csv") in report.write(cell.folder)


OF_STUDIES = reference_solution, convergence_study, work_and_precision
TOOLS = {tool.__name__: tool for tool in (*OF_STUDIES, monodromy, linearise, two_cases, all_cases)}
REFUSED = {}
FULL = {("all_cases", system) for system in SYSTEMS}
"""A minute of processor time each: ten programs are compiled, of which the batch with a lane that fails takes a
third."""


@cells(TOOLS, FULL)
def test_cell(tool: str, system: str, tmp_path, monkeypatch: pytest.MonkeyPatch):
    check(TOOLS, REFUSED, tool, Cell(system, tmp_path, monkeypatch))

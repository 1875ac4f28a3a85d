"""Every system through the studies of accuracy and cost; `tune` and `cost_report` are run by the commands `tune` and `cost`."""

import numpy as np
import pytest

from tests.tools.table import MACRO_DT, SCHEME, T_END, Cell, cells, check
from vmri_jax import plots, study


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


TOOLS = {tool.__name__: tool for tool in (reference_solution, convergence_study, work_and_precision)}
REFUSED = {}


@cells(TOOLS)
def test_cell(tool: str, system: str, tmp_path, monkeypatch: pytest.MonkeyPatch):
    check(TOOLS, REFUSED, tool, Cell(system, tmp_path, monkeypatch))

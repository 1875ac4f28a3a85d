"""Every system through the hard cases of `vmri check`: two that compile little, and all of them with --full."""

import pytest

from tests.small_systems import SYSTEMS
from tests.tools.table import Cell, cells, check
from vmri_jax.hard_cases import cases_for, run_cases

TINY_STEPS, REDUCTIONS = 6, 9


def two_cases(cell: Cell) -> None:
    report = run_cases(cases_for(cell.moving), (TINY_STEPS, REDUCTIONS))
    assert report.passed, str(report)


def all_cases(cell: Cell) -> None:
    report = run_cases(cases_for(cell.moving))
    assert report.passed, str(report)
    assert (cell.folder / "cases.csv") in report.write(cell.folder)


TOOLS = {"two_cases": two_cases, "all_cases": all_cases}
REFUSED = {}
FULL = {("all_cases", system) for system in SYSTEMS}
"""A minute of processor time each: ten programs are compiled, of which the batch with a lane that fails takes a third."""


@cells(TOOLS, FULL)
def test_cell(tool: str, system: str, tmp_path, monkeypatch: pytest.MonkeyPatch):
    check(TOOLS, REFUSED, tool, Cell(system, tmp_path, monkeypatch))

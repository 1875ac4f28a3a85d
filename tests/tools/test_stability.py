"""Every system through what linearises it; `advise` and `stability_map` are run by the commands of these names."""

import numpy as np
import pytest

from tests.tools.table import MACRO_DT, SCHEME, Cell, cells, check
from vmri_jax import diagnostics, stability


def monodromy(cell: Cell) -> None:
    product = stability.monodromy(cell.moving, SCHEME, macro_dt=MACRO_DT, num_steps=2)
    assert str(product)


def linearise(cell: Cell) -> None:
    linear = diagnostics.linearise(cell.moving)
    assert str(linear)
    assert np.isfinite(linear.frequencies).all()
    assert (np.diff(linear.frequencies) <= 0).all()
    assert linear.kinetic_shares.sum(axis=0) == pytest.approx(1.0)


TOOLS = {tool.__name__: tool for tool in (monodromy, linearise)}
REFUSED = {}


@cells(TOOLS)
def test_cell(tool: str, system: str, tmp_path, monkeypatch: pytest.MonkeyPatch):
    check(TOOLS, REFUSED, tool, Cell(system, tmp_path, monkeypatch))

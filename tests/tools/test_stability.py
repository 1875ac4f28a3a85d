"""Every system through what linearises it; `advise` and `stability_map` are run by the commands of these names."""

import numpy as np
import pytest

from tests.tools.table import MACRO_DT, SCHEME, Cell, cells, check
from vmri_jax import diagnostics, stability


def monodromy(cell: Cell) -> None:
    product = stability.monodromy(cell.moving, SCHEME, macro_dt=MACRO_DT, num_steps=2)
    assert str(product)


def vibrations(cell: Cell) -> None:
    small = stability.vibrations(cell.moving)
    assert str(small)
    found = np.array([row.frequency for row in small.rows])
    if cell.problem.system.is_constrained:  # whose forces `frequencies` leaves out
        assert np.isfinite(found).all()
        assert (np.diff(found) <= 0).all()
    else:
        np.testing.assert_allclose(found, diagnostics.frequencies(cell.moving), atol=1e-6)


TOOLS = {tool.__name__: tool for tool in (monodromy, vibrations)}
REFUSED = {}


@cells(TOOLS)
def test_cell(tool: str, system: str, tmp_path, monkeypatch: pytest.MonkeyPatch):
    check(TOOLS, REFUSED, tool, Cell(system, tmp_path, monkeypatch))

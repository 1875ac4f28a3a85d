"""The notebooks run from top to bottom, and show what is stored in them."""

import copy

import nbformat
import pytest

from tests.notebooks import VARIES, executed, paths, shown

LONG = ("02_what_accuracy_costs", "03_hard_cases")
LARGEST = 600_000
"""Bytes of a notebook with its outputs."""


@pytest.mark.parametrize(
    "path", [pytest.param(path, marks=pytest.mark.full if path.stem in LONG else (), id=path.stem) for path in paths()]
)
def test_a_notebook_shows_what_it_holds(path, tmp_path):
    """Else `make notebooks` stores what it shows now."""
    assert shown(executed(path, tmp_path)) == shown(nbformat.read(path, 4))


@pytest.mark.parametrize("path", paths(), ids=lambda path: path.stem)
def test_a_notebook_holds_its_outputs(path):
    notebook = nbformat.read(path, 4)
    assert all(cell.execution_count for cell in notebook.cells if cell.cell_type == "code")
    assert any("image/png" in cell["kinds"] for cell in shown(notebook))
    assert path.stat().st_size < LARGEST


def test_other_numbers_and_missing_figures_are_noticed():
    notebook = nbformat.read(paths()[0], 4)
    for kind in ("stream", "display_data"):
        changed = copy.deepcopy(notebook)
        compared = [cell for cell in changed.cells if VARIES not in cell.metadata.get("tags", [])]
        [output, *_] = [o for cell in compared for o in cell.get("outputs", []) if o.output_type == kind]
        if kind == "stream":
            output.text = output.text.replace("1", "2", 1)
        else:
            del output.data["image/png"]
        assert shown(changed) != shown(notebook)

"""The notebooks run from top to bottom (in a quick form)."""

import warnings
from pathlib import Path

import nbclient
import nbformat
import pytest

NOTEBOOKS = sorted((Path(__file__).parent.parent / "notebooks").glob("*.ipynb"))


LONG = ("02_what_accuracy_costs", "03_hard_cases")


@pytest.mark.parametrize(
    "path",
    [pytest.param(path, marks=pytest.mark.full if path.stem in LONG else (), id=path.stem) for path in NOTEBOOKS],
)
def test_notebook_runs(path, tmp_path, monkeypatch):
    monkeypatch.setenv("VMRI_QUICK", "1")
    notebook = nbformat.read(path, 4)
    client = nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the Jupyter machinery, not of the notebook's own process
        client.execute()
    assert all(cell.execution_count for cell in notebook.cells if cell.cell_type == "code")

"""Executes the notebooks; ``python -m tests.notebooks`` stores their outputs, of all or of those that are named."""

import re
import sys
import tempfile
import warnings
from pathlib import Path

import nbclient
import nbformat

FOLDER = Path(__file__).parent.parent / "notebooks"
VARIES = "varies"
"""Tag of a cell whose text is not the same on every machine: times, and numbers at round-off."""


def paths() -> list[Path]:
    """All notebooks."""
    return sorted(FOLDER.glob("*.ipynb"))


def executed(path: Path, folder: Path) -> nbformat.NotebookNode:
    """The notebook with the outputs of a run from top to bottom.

    Args:
        path: of the notebook.
        folder: where it runs: files that it writes are there.
    """
    notebook = nbformat.read(path, 4)
    client = nbclient.NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(folder)}})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the Jupyter machinery, not of the notebook's own process
        client.execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)  # times
        if cell.cell_type == "code":
            cell.outputs = _joined(cell.outputs)
    return notebook


def shown(notebook: nbformat.NotebookNode) -> list[dict]:
    """What every code cell shows: its printed text, which kinds of other outputs; the kinds alone where the text
    varies.

    Args:
        notebook: with outputs.
    """
    found = []
    for cell in notebook.cells:
        if cell.cell_type == "code":
            printed = "".join(output.text for output in cell.outputs if output.output_type == "stream")
            kinds = sorted(kind for output in cell.outputs for kind in output.get("data", {}))
            varies = VARIES in cell.metadata.get("tags", [])
            found.append({"source": cell.source, "printed": bool(printed) if varies else printed, "kinds": kinds})
    return found


def _joined(outputs: list) -> list:
    """Pieces of one stream as one, without what goes to stderr (progress); addresses of objects are not the same
    twice."""
    kept = []
    for output in outputs:
        if output.output_type == "stream" and output.name == "stderr":
            continue
        if kept and output.output_type == kept[-1].output_type == "stream":
            kept[-1].text += output.text
            continue
        kept.append(output)
    for output in kept:
        if "text/plain" in output.get("data", {}):
            output.data["text/plain"] = re.sub(r" at 0x[0-9a-f]+", "", output.data["text/plain"])
    return kept


def main() -> None:
    for path in paths():
        if not sys.argv[1:] or path.stem in sys.argv[1:]:
            with tempfile.TemporaryDirectory() as folder:
                nbformat.write(executed(path, Path(folder)), path)
            print(f"{path.name}  {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()

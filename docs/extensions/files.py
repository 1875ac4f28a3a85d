"""Files that Sphinx reads and we write."""

from pathlib import Path


def keep(path: Path, text: str) -> None:
    """Writes only what has changed, so that Sphinx builds no page twice."""
    if not path.exists() or path.read_text() != text:
        path.write_text(text)

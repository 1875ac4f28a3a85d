"""The scenes of `notebooks/scenes` by name."""

from functools import cache
from pathlib import Path

from vmri_jax.catalogue import imported
from vmri_jax.scene import Scene

FOLDER = Path(__file__).parents[2] / "notebooks" / "scenes"
SCENES = sorted(path.stem for path in FOLDER.glob("*.py") if path.stem != "gallery")


@cache
def gallery_scene(name: str) -> Scene:
    """The scene in a file of the gallery."""
    return imported(f"{FOLDER / name}.py:scene")

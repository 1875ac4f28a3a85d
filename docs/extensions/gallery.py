"""The gallery: every scene file with its picture, and its motion to play."""

import ast
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

from sphinx_gallery.scrapers import figure_rst

from extensions.files import keep

HEAD = """Scenes
======

Each of these is a file as a user writes one. ``vmri simulate`` runs it, ``vmri animate`` shows it, ``vmri explain``
says in which term and on which grid each effect is, and its time. The pages play in the browser: drag to turn, the
wheel to come closer.
"""


def settings(scenes: Path, docs: Path) -> dict:
    """For sphinx-gallery, after its sources are written.

    Args:
        scenes: the folder with the scene files and their pictures.
        docs: the folder of the site.
    """
    sources = docs / "gallery_sources"
    sources.mkdir(exist_ok=True)
    keep(sources / "GALLERY_HEADER.rst", HEAD)
    for path in sorted(scenes.glob("*.py")):
        if path.name != "gallery.py":
            keep(sources / path.name, with_title(path))

    def picture(block, block_vars, gallery_conf) -> str:
        source = Path(block_vars["src_file"])
        if "scene" not in block_vars["example_globals"]:
            return ""
        path = Path(next(block_vars["image_path_iterator"]))
        path.write_bytes((scenes / source.name).with_suffix(".png").read_bytes())
        page = docs / "_static" / "scenes" / f"{source.stem}.html"
        if not page.exists() or page.stat().st_mtime < (scenes / source.name).stat().st_mtime:
            page.parent.mkdir(parents=True, exist_ok=True)
            play(scenes / source.name, docs.parent, ["--out", str(page)])
        frame = (
            f'<iframe class="motion" loading="lazy" title="{source.stem}" src="../_static/scenes/{page.name}"></iframe>'
        )
        return figure_rst([str(path)], gallery_conf["src_dir"]) + f"\n\n.. raw:: html\n\n    {frame}\n\n"

    return {
        "examples_dirs": str(sources),
        "gallery_dirs": "gallery",
        "filename_pattern": "/",
        "image_scrapers": (picture,),
        "download_all_examples": False,
        "min_reported_time": 1e9,
        "write_computation_times": False,
        "show_signature": False,
    }


def docstring(path: Path) -> tuple[list[str], list[str]]:
    """Paragraphs of a scene's docstring, and the commands in it."""
    paragraphs = (ast.get_docstring(ast.parse(path.read_text())) or "").split("\n\n")
    commands = [line.strip() for part in paragraphs for line in part.splitlines() if line.startswith("    vmri ")]
    return [part for part in paragraphs if not part.startswith("    ")], commands


def with_title(path: Path) -> str:
    """The scene file with a docstring as sphinx-gallery takes it."""
    paragraphs, commands = docstring(path)
    title = path.stem.replace("_", " ").capitalize()
    text = "\n\n".join(part.replace("`", "``") for part in paragraphs)
    shown = "\n".join(f"    {command}" for command in commands)
    source = path.read_text()
    body = source[source.index('"""', 3) + 3 :]
    return f'"""\n{title}\n{"=" * len(title)}\n\n{text}\n\n.. code-block:: sh\n\n{shown}\n"""\n{body}'


def play(path: Path, root: Path, *shown: list[str]) -> None:
    """Runs a scene by the command in its docstring, and shows its motion.

    Args:
        path: of the scene file.
        root: of the repository.
        shown: arguments of `vmri animate`, of each picture of it.
    """
    simulate = shlex.split(docstring(path)[1][0])[1:]
    vmri = [sys.executable, "-m", "vmri_jax.cli"]
    with tempfile.TemporaryDirectory() as folder:
        run = f"{folder}/run.npz"
        simulate[simulate.index("--out") + 1] = run
        for command in (simulate, *(["animate", run, *arguments] for arguments in shown)):
            subprocess.run([*vmri, *command], cwd=root, check=True, capture_output=True)

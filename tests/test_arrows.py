"""Imports: each module of the package imports from modules before it, lazy and typed-only imports included; benchmarks
import no tests."""

import ast
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "vmri_jax"
REFERENCES = ("benchmarks.gail2014.dense", "benchmarks.body_motions")
"""Dense solves and accelerations of bodies, which tests compare with."""
LINES = {
    ("animation",): 1860,
    ("cli",): 990,
    ("control",): 880,
    ("ensembles", "executors"): 1490,
    ("plots",): 1000,
    (".",): 36_235,
}
"""Most lines of packages that have reached their number, and of the whole: a change that adds takes away."""


def modules(package: Path) -> dict[str, Path]:
    """Files of all modules of a package by name; the face of the package itself is left out, since it imports all of
    them."""
    names = {path: path.relative_to(package.parent).with_suffix("").parts for path in package.rglob("*.py")}
    named = {".".join(parts[:-1] if parts[-1] == "__init__" else parts): path for path, parts in names.items()}
    return {name: path for name, path in named.items() if name != package.name}


def imports(path: Path, known: dict[str, Path]) -> Iterator[str]:
    """Modules of the package that a file imports, wherever in it."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in known)
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                yield from [inner] if inner in known else [node.module] if node.module in known else []


def sorted_modules(package: Path) -> list[str]:
    """Modules in an order in which each imports from those before it.

    Raises:
        graphlib.CycleError: there is none; the error has the circle.
    """
    known = modules(package)
    return list(
        TopologicalSorter({name: set(imports(path, known)) - {name} for name, path in known.items()}).static_order()
    )


def test_the_imports_of_the_package_have_no_circle():
    order = sorted_modules(PACKAGE)
    assert order.index("vmri_jax.mechanics.system") < order.index("vmri_jax.running.engine")


def test_no_module_imports_the_face_of_the_package():
    for path in PACKAGE.rglob("*.py"):
        faces = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Import)]
        assert not [path for node in faces for alias in node.names if alias.name == "vmri_jax"]


def test_benchmarks_and_tests_stand_beside_each_other():
    """Benchmarks import no test; tests of benchmarks, and of pages that print their commands, import benchmarks.

    All others import `REFERENCES` alone.
    """
    root = PACKAGE.parent
    for folder, other, allowed in (("benchmarks", "tests", ()), ("tests", "benchmarks", ("benchmarks", "pages"))):
        for path in (root / folder).rglob("*.py"):
            if path.relative_to(root).parts[1] not in allowed:
                nodes = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)]
                names = [node.module or "" for node in nodes]
                assert not [name for name in names if name.split(".")[0] == other and name not in REFERENCES], path


@pytest.mark.parametrize(("folders", "most"), LINES.items())
def test_packages_do_not_grow(folders, most):
    files = (path for folder in folders for path in (PACKAGE / folder).rglob("*.py"))
    assert sum(len(path.read_text().splitlines()) for path in files) <= most


def test_a_circle_is_seen(tmp_path):
    package = tmp_path / "pack"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "a.py").write_text("def f():\n    from pack.b import g\n    return g\n")
    (package / "b.py").write_text("from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from pack import a\n")
    with pytest.raises(CycleError):
        sorted_modules(package)

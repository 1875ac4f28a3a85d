"""The face of the package: users' names in groups, and nothing else."""

import ast
import inspect
import re
import subprocess
import sys
import textwrap
import tomllib
from pathlib import Path

import pytest

import vmri_jax as vm
from vmri_jax.running import trajectory
from vmri_jax.running.store import layout

ROOT = Path(__file__).parents[1]


def test_every_name_is_there_and_stands_in_a_group():
    words = set(re.findall(r"\w+", vm.__doc__ or ""))
    assert dir(vm) == sorted(vm.__all__)
    for name in dir(vm):
        assert getattr(vm, name) is not None
        assert name in words, f"help(vmri_jax) does not name {name}"


def test_examples_in_docstrings_are_python():
    """Wrapping has broken one before: lines of code had become one line."""
    examples = 0
    for name in dir(vm):
        text = inspect.cleandoc(getattr(vm, name).__doc__ or "").split("\nArgs:")[0]
        for example in re.findall(r"(?m)^(?: {4}.+\n?)+", text):
            if "vm." in example:
                ast.parse(textwrap.dedent(example))
                examples += 1
    assert examples > 5


def test_unknown_names_are_refused():
    with pytest.raises(AttributeError, match="module 'vmri_jax' has no attribute 'simulat'"):
        vm.simulat  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]


def test_the_first_import_draws_nothing():
    """matplotlib and the rooms that draw, which take half a second, and scenes are imported when they are asked for."""
    later = "{'matplotlib', 'vmri_jax.scene', 'vmri_jax.study'} & set(sys.modules)"
    program = f"import sys, vmri_jax as vm; print({later}); vm.scene.Scene; vm.tune"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_the_page_of_what_stays_names_the_formats_of_files():
    page = (ROOT / "docs" / "what_stays.md").read_text(encoding="utf-8")
    assert all(f"`{name}`" in page for name in (trajectory.FORMAT, layout.FORMAT))


def test_versions_agree():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\n## {version}\n" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")

"""Every shell command that a page prints runs as printed, and its output begins as the page says below it.

A page shows commands in blocks marked `sh`. A block marked `text` right below such a block, with one line of words between them at most,
holds the first lines that the last of these commands prints; `...` stands for numbers that differ from run to run.
Commands of `vmri` run in this process, so that they share compiled programs.
"""

import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest
import typer
from typer.testing import CliRunner

from benchmarks.__main__ import app as benchmarks
from vmri_jax.cli import app as vmri

ROOT = Path(__file__).parents[2]
PAGES = ("README.md", "CONTRIBUTING.md", "benchmarks/README.md", "notebooks/scenes/README.md", "docs/**/*.md")
FILES = {"crane.py": "README.md", "my_scene.py": "docs/how_to/scenes.md"}
"""Files that commands name, and the page whose first program is in it."""

CODES = {"vmri advise fpu": 1}
"""Exit codes other than 0: a step that is advised against."""
SMALLER = {"python -m benchmarks hard": "--case 24", "python -m benchmarks fuzz": "--count 1 --out fuzz"}
"""Options that make minutes to seconds: one case of 28, one system of 2000."""
NOT_RUN = {
    "make": "each target is a command of CI, or takes minutes to hours; only its name is tested",
    ".ci/run": "is what runs the tests",
    "pip": "installs from the internet, as the first step of CI does",
    "#!/bin/bash": "a job for a cluster",
    "python -m benchmarks": "minutes to hours on an idle machine; options are tested, tests/benchmarks runs small forms",
}
"""Beginnings of lines that are not run, and why."""


class Block(NamedTuple):
    """The commands of one block of a page, and the first lines of what the last one prints, as far as the page shows them."""

    page: str
    commands: tuple[str, ...]
    begins: tuple[str, ...]


def blocks() -> list[Block]:
    """All blocks of shell commands of all pages."""
    pattern = re.compile(r"```sh\n(.*?)```\n(?:(?:\n[^\n`]*\S\n)?\n```text\n(.*?)```)?", re.DOTALL)
    found = []
    for path in sorted(path for page in PAGES for path in ROOT.glob(page) if "_build" not in path.parts):
        for lines, text in pattern.findall(path.read_text(encoding="utf-8")):
            script = lines.startswith("#!")
            commands = [lines] if script else lines.replace("\\\n", " ").splitlines()
            commands = tuple(c if script else shlex.join(shlex.split(c, comments=True)) for c in commands)
            found.append(Block(str(path.relative_to(ROOT)), tuple(filter(None, commands)), tuple(text.splitlines())))
    return found


def reason(command: str) -> str:
    """Why a command is not run; nothing if it is."""
    command = command.removeprefix(".venv/bin/")
    if any(command == line for line in SMALLER):
        return ""
    return next((why for start, why in NOT_RUN.items() if command.startswith(start)), "")


def name_and_options(app: typer.Typer, words: list[str]) -> dict:
    """What the parser of a command line makes of its words; it refuses those that it does not know."""
    group = typer.main.get_command(app)
    with group.make_context("", list(words)) as context:  # pyright: ignore
        command = group.get_command(context, words[0])  # pyright: ignore
        assert command is not None, f"there is no command {words[0]}"
        return command.make_context(words[0], words[1:], parent=context).params


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the files that the commands name; and what each command printed that was run in it."""
    place = tmp_path_factory.mktemp("commands")
    for name, page in FILES.items():
        [program, *_] = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL)
        (place / name).write_text(program)
    (place / "notebooks").symlink_to(ROOT / "notebooks")
    return place, {}


def run(command: str, folder: tuple[Path, dict[str, str]]) -> str:
    """What a command prints; one that two pages show is run once."""
    place, printed = folder
    if command not in printed:
        code = next((code for start, code in CODES.items() if command.startswith(start)), 0)
        if command.startswith("vmri "):
            with pytest.MonkeyPatch.context() as patch:
                patch.chdir(place)
                done = CliRunner().invoke(vmri, shlex.split(command)[1:])
            assert done.exit_code == code, done.output
            printed[command] = done.output
        else:
            words = [sys.executable, *shlex.split(f"{command} {SMALLER[command]}")[1:]]
            path = {"PYTHONPATH": str(ROOT)}
            done = subprocess.run(words, cwd=place, env=_environment() | path, capture_output=True, text=True, check=False)
            assert done.returncode == code, done.stderr
            printed[command] = done.stdout
    return printed[command]


def _environment() -> dict[str, str]:
    import os

    return dict(os.environ)


def test_pages_are_read():
    commands = {command for block in blocks() for command in block.commands}
    assert {"make test", "vmri check crane.py:crane", "python -m benchmarks hard"} <= commands
    assert len(commands) > 60


RUN = [block for block in blocks() if not all(map(reason, block.commands))]


@pytest.mark.parametrize("block", RUN, ids=lambda block: f"{block.page}: {block.commands[0]}")
def test_commands_run_as_printed(block, folder):
    """Above 20 s: `vmri tune` and `vmri cost`, which compile some twenty schemes; the rigid scenes of the gallery, for now."""
    printed = [run(command, folder) for command in block.commands if not reason(command)]
    seen = [" ".join(line.split()) for line in printed[-1].splitlines() if line.strip()]
    for line in block.begins:
        pattern = re.escape(" ".join(line.split())).replace(r"\.\.\.", ".*")
        assert any(re.fullmatch(pattern, other) for other in seen), f"{line!r} is not in:\n{printed[-1]}"


@pytest.mark.parametrize("block", [block for block in blocks() if block not in RUN], ids=lambda block: block.page)
def test_commands_that_are_not_run_exist(block):
    for command in block.commands:
        for part in command.split(" && "):
            program, *words = shlex.split(part) if not part.startswith("#!") else ["bash"]
            if program == "make":
                assert f"\n{words[0]}:" in (ROOT / "Makefile").read_text()
            elif words[:2] == ["-m", "benchmarks"]:
                assert name_and_options(benchmarks, words[2:]) is not None
            elif program.startswith(".ci/"):
                assert (ROOT / program).exists()


def sentences() -> list[tuple[str, str]]:
    """Commands within sentences and tables, with the page."""
    found = []
    for path in sorted(path for page in PAGES for path in ROOT.glob(page) if "_build" not in path.parts):
        text = re.sub(r"```.*?```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
        found += [(str(path.relative_to(ROOT)), c) for c in re.findall(r"`((?:vmri|python -m benchmarks) [^`]*)`", text)]
    return found


@pytest.mark.parametrize(("page", "command"), sentences())
def test_commands_in_sentences_exist(page, command):
    app, words = (vmri, command.split()[1:]) if command.startswith("vmri") else (benchmarks, command.split()[3:])
    known = typer.main.get_command(app).commands[words[0]]  # pyright: ignore
    options = {option for parameter in known.params for option in (*parameter.opts, *parameter.secondary_opts)}
    assert {word for word in words if word.startswith("--")} <= options

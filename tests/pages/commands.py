"""Shell commands of pages: where they stand, what they print there, and how they run."""

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
import typer
from typer.testing import CliRunner

from vmri_jax.cli import app as vmri

ROOT = Path(__file__).parents[2]
PAGES = ("README.md", "CONTRIBUTING.md", "benchmarks/README.md", "docs/**/*.md")
GALLERY = "notebooks/scenes/README.md"
SEARCHES = ("vmri tune", "vmri cost")
"""Commands of two minutes: they have a file of tests for themselves, so that two workers share the commands."""
FILES = {"crane.py": "docs/nutshell.md", "my_scene.py": "docs/how_to/scenes.md"}
"""Files that commands name, each the first program of a page."""
CODES = {"vmri advise fpu": 1}
"""Exit codes other than 0: a step that is advised against."""
SMALLER = {"python -m benchmarks hard": "--case 9", "python -m tests.fuzz": "--count 1 --out fuzz"}
"""Options that make minutes to seconds: one case of 19, one system of 2000."""
NOT_RUN = {
    "make": "a command of CI, or one of hours; only the target is looked up",
    ".ci/run": "CI itself",
    "pip": "installs from the internet, as the first step of CI does",
    "#!/bin/bash": "a job for a cluster",
    "python -m benchmarks": (
        "takes minutes to hours on an idle machine; only its options are tested here, small forms in tests/benchmarks"
    ),
}
"""Beginnings of commands that are not run, and why."""
BLOCK = re.compile(r"```sh\n(.*?)```\n(?:(?:\n[^\n`]*\n)?\n```text\n(.*?)```)?", re.DOTALL)
"""A block of commands; with the block of text below it, if one line of words at most stands between them."""


class Block(NamedTuple):
    """The commands of one block of a page, and lines that the last one prints, as far as the page shows them."""

    page: str
    commands: tuple[str, ...]
    lines: tuple[str, ...]


def paths(*pages: str) -> list[Path]:
    """Files of pages, from patterns seen from the root of the repository; the built site is left out."""
    found = {path for page in pages for path in ROOT.glob(page)}
    return sorted(path for path in found if "_build" not in path.parts)


def blocks(*pages: str) -> list[Block]:
    """All blocks of shell commands of some pages; a script that starts with `#!` is one command."""
    made = []
    for path in paths(*pages):
        for shown, text in BLOCK.findall(path.read_text(encoding="utf-8")):
            script = shown.startswith("#!")
            commands = [shown] if script else shown.replace("\\\n", " ").splitlines()
            if not script:
                commands = [shlex.join(shlex.split(command, comments=True)) for command in commands]
            made.append(Block(str(path.relative_to(ROOT)), tuple(filter(None, commands)), tuple(text.splitlines())))
    return made


def sentences(*pages: str) -> list[tuple[str, str]]:
    """Commands within sentences and tables, with their page."""
    made = []
    for path in paths(*pages):
        text = re.sub(r"```.*?```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
        commands = re.findall(r"[`>]((?:vmri|python -m benchmarks) [^`<]*)", text)
        made += [(str(path.relative_to(ROOT)), command) for command in commands]
    return made


def parsed(app: typer.Typer, words: list[str]) -> None:
    """Refuses words that the parser of a command line does not know."""
    group = typer.main.get_command(app)
    with group.make_context("", list(words)) as context:  # pyright: ignore
        command = group.get_command(context, words[0])  # pyright: ignore
        assert command is not None, f"there is no command {words[0]}"
        command.make_context(words[0], words[1:], parent=context)


def options(app: typer.Typer, name: str) -> set[str]:
    """The options of a command."""
    command = typer.main.get_command(app).commands[name]  # pyright: ignore
    return {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}


def output(command: str, folder: Path, code: int = 0) -> str:
    """What a command prints in a folder; `vmri` runs in this process, so that commands share compiled programs.

    Args:
        command: of `vmri`, or of `python`.
        folder: in which it runs.
        code: the exit code that is right.
    """
    program, *words = shlex.split(command)
    if program == "vmri":
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(folder)
            patch.delenv("COLUMNS", raising=False)  # set by workers of pytest; a pipe has no width
            done = CliRunner().invoke(vmri, words)
        assert done.exception is None or isinstance(done.exception, SystemExit), repr(done.exception)
        assert done.exit_code == code, done.output
        return done.output
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    environment.pop("COLUMNS", None)
    run = subprocess.run(
        [sys.executable, *words], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert run.returncode == code, run.stderr
    return run.stdout


def shows(printed: str, line: str) -> bool:
    """Whether a line is among those that were printed; `...` in it stands for anything, spaces for any number of
    spaces."""
    pattern = re.escape(" ".join(line.split())).replace(r"\.\.\.", ".*")
    return any(re.fullmatch(pattern, " ".join(other.split())) for other in printed.splitlines())


def why_not_run(command: str) -> str:
    """The reason why a command is not run; nothing if it is."""
    command = command.removeprefix(".venv/bin/")
    return next((why for start, why in NOT_RUN.items() if command.startswith(start) and command not in SMALLER), "")


def runs(block: Block) -> bool:
    """Whether any command of a block is run."""
    return not all(map(why_not_run, block.commands))


def check(block: Block, run: Callable[[str], str]) -> None:
    """Runs the commands of a block, and compares the last output with the lines that the page shows."""
    printed = [run(command) for command in block.commands if not why_not_run(command)]
    for line in block.lines:
        assert shows(printed[-1], line), f"{line!r} is not in:\n{printed[-1]}"

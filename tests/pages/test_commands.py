"""Every shell command that a page prints runs as printed, and prints the lines that the page shows below it.

A block marked `text` below a block marked `sh`, with one line of words between them at most, holds lines that the last of its
commands prints. Commands that two pages print run once.
"""

import re
import shlex

import pytest

from benchmarks.__main__ import app as benchmarks
from tests.pages.commands import ROOT, blocks, options, output, parsed, sentences, shows
from vmri_jax.cli import app as vmri

PAGES = ("README.md", "CONTRIBUTING.md", "benchmarks/README.md", "docs/**/*.md")
GALLERY = "notebooks/scenes/README.md"
FILES = {"crane.py": "README.md", "my_scene.py": "docs/how_to/scenes.md"}
"""Files that commands name, each the first program of a page."""
CODES = {"vmri advise fpu": 1}
"""Exit codes other than 0: a step that is advised against."""
SMALLER = {"python -m benchmarks hard": "--case 24", "python -m benchmarks fuzz": "--count 1 --out fuzz"}
"""Options that make minutes to seconds: one case of 28, one system of 2000."""
NOT_RUN = {
    "make": "a command of CI, or one of hours; only the target is looked up",
    ".ci/run": "CI itself",
    "pip": "installs from the internet, as the first step of CI does",
    "#!/bin/bash": "a job for a cluster",
    "python -m benchmarks": "takes minutes to hours on an idle machine; only its options are tested here, small forms in tests/benchmarks",
}
"""Beginnings of commands that are not run, and why."""


def why_not_run(command: str) -> str:
    """The reason why a command is not run; nothing if it is."""
    command = command.removeprefix(".venv/bin/")
    return next((why for start, why in NOT_RUN.items() if command.startswith(start) and command not in SMALLER), "")


BLOCKS = blocks(*PAGES)
RUN = [block for block in BLOCKS if not all(map(why_not_run, block.commands))]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Runs a command, unless it has been run, in a folder with the files that commands name: what it prints."""
    folder, printed = tmp_path_factory.mktemp("commands"), {}
    for name, page in FILES.items():
        text = (ROOT / page).read_text(encoding="utf-8")
        (folder / name).write_text(re.findall(r"```python\n(.*?)```", text, re.DOTALL)[0])

    def once(command: str) -> str:
        if command not in printed:
            code = next((code for start, code in CODES.items() if command.startswith(start)), 0)
            printed[command] = output(f"{command} {SMALLER.get(command, '')}", folder, code)
        return printed[command]

    return once


@pytest.mark.parametrize("block", RUN, ids=lambda block: f"{block.page}: {block.commands[0]}")
def test_commands_run_as_printed(block, run):
    """`vmri check`, `tune`, `cost` and `stability` take above 20 s: they compile 10 to 40 programs each, and have died late before."""
    printed = [run(command) for command in block.commands if not why_not_run(command)]
    for line in block.lines:
        assert shows(printed[-1], line), f"{line!r} is not in:\n{printed[-1]}"


@pytest.mark.parametrize("block", [block for block in BLOCKS if block not in RUN], ids=lambda block: block.page)
def test_commands_that_are_not_run_exist(block):
    for command in block.commands:
        for part in command.split(" '&&' ") if not command.startswith("#!") else ():
            program, *words = shlex.split(part)
            if program == "make":
                assert f"\n{words[0]}:" in (ROOT / "Makefile").read_text()
            elif words[:2] == ["-m", "benchmarks"]:
                parsed(benchmarks, words[2:])
            elif program.startswith(".ci/"):
                assert (ROOT / program).exists()


@pytest.mark.parametrize(("page", "command"), sentences(*PAGES, GALLERY))
def test_commands_in_sentences_exist(page, command):
    app, words = (vmri, command.split()[1:]) if command.startswith("vmri") else (benchmarks, command.split()[3:])
    assert {word for word in words if word.startswith("--")} <= options(app, words[0]), page


def test_blocks_are_read():
    """Commands, comments, continued lines, the text below."""
    commands = {command for block in BLOCKS for command in block.commands}
    assert {"make test", "vmri check crane.py:crane", "python -m benchmarks hard"} <= commands
    assert sum(bool(block.lines) for block in RUN) >= 4
    assert shows("a   12 s\nb", "a ... s")
    assert not shows("a   12 s\nb", "a 12")

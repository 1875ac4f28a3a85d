"""Every shell command that a page prints runs as printed, and prints the lines that the page shows below it.

A block marked `text` below a block marked `sh`, with one line of words between them at most, holds lines that the last
of its commands prints. Commands that two pages print run once.
"""

import shlex

import pytest

from benchmarks.__main__ import app as benchmarks
from tests.pages.commands import GALLERY, PAGES, ROOT, SEARCHES, blocks, check, options, parsed, runs, sentences, shows
from vmri_jax.cli import app as vmri

BLOCKS = [block for block in blocks(*PAGES) if not block.commands[0].startswith(SEARCHES)]


@pytest.mark.parametrize("block", [*filter(runs, BLOCKS)], ids=lambda block: f"{block.page}: {block.commands[0]}")
def test_commands_run_as_printed(block, run):
    """`vmri check` takes 66 s of processor time and `vmri stability` 35: they compile 10 to 30 programs each."""
    check(block, run)


@pytest.mark.parametrize("block", [block for block in BLOCKS if not runs(block)], ids=lambda block: block.page)
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
    assert sum(bool(block.lines) for block in BLOCKS) >= 4
    assert shows("a   12 s\nb", "a ... s")
    assert not shows("a   12 s\nb", "a 12")

"""The command line in the process of the tests."""

import re

import pytest
from typer.testing import CliRunner

from vmri_jax import cli


@pytest.fixture
def vmri(tmp_path, monkeypatch):
    """Runs ``vmri`` in an empty folder: (exit code, everything printed with frames and line breaks taken out)."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        result = CliRunner().invoke(cli.app, [str(argument) for argument in arguments])
        assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
        return result.exit_code, re.sub(r"[\s│╭╮╰╯─]+", " ", result.output)

    return run

"""`vmri new`: files that run as they are written, and the map of commands."""

import runpy

import pytest
from typer.testing import CliRunner

from vmri_jax import cli

RUNNER = CliRunner()


@pytest.mark.parametrize("options", [[], ["--scene"]], ids=["system", "scene"])
def test_what_is_written_runs(tmp_path, monkeypatch, capsys, options):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "mine.py"
    written = RUNNER.invoke(cli.app, ["new", str(path), *options])
    assert written.exit_code == 0, written.output
    assert "FILE" not in path.read_text()
    runpy.run_path(str(path), run_name="__main__")
    assert capsys.readouterr().out.strip() == "energy kept to 0.0357 J"
    assert (tmp_path / "run.png").exists()
    again = RUNNER.invoke(cli.app, ["new", str(path)])
    assert again.exit_code == 2
    assert "exists already" in " ".join(again.output.replace("│", " ").split())


def test_another_ending_is_refused(tmp_path):
    assert RUNNER.invoke(cli.app, ["new", str(tmp_path / "mine.txt")]).exit_code == 2


def test_without_a_command_it_shows_four_groups():
    shown = RUNNER.invoke(cli.app, []).output
    for group in ("Run and see", "Is it right", "What it costs", "Many runs"):
        assert group in shown
    for command in cli.app.registered_commands:
        assert command.rich_help_panel

"""Quick forms of the hard cases of this project: every criterion is met, and what a prototype measured is measured
again."""

import pytest
from typer.testing import CliRunner

from benchmarks.__main__ import app
from benchmarks.hard_cases import catalogue

CASES = catalogue()

# (case, value): what an independent prototype measured; the quick forms come within 20 %
MEASURED = {
    ("impulse resonance", "first_unstable_2"): 1.248,
    ("impulse resonance", "first_unstable_5"): 1.025,
    ("implicit combination resonance", "growth"): 8.4e-4,
    ("large macro step", "iterations"): 6,
    ("large constrained step", "iterations"): 4,
    ("mass ratios 1e4 to 1e8", "iterations_1e+06"): 3,
}


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.number}-{case.title.replace(' ', '-')}")
def test_criterion_is_met(case):
    outcome = case.run(False)
    assert outcome.passed, outcome.measured
    for (title, name), value in MEASURED.items():
        if title == case.title:
            assert outcome.values[name] == pytest.approx(value, rel=0.2)


@pytest.fixture
def prepared(monkeypatch):
    """JAX runs already in this process."""
    monkeypatch.setattr("benchmarks.hard_cases.prepare", lambda: None)


@pytest.mark.usefixtures("prepared")
def test_the_command_refuses_an_unknown_case():
    result = CliRunner().invoke(app, ["hard", "--case", "99"])
    assert result.exit_code == 2
    assert "there is no case 99" in result.output


@pytest.mark.usefixtures("prepared")
def test_the_command_runs_a_case_and_writes_files(tmp_path):
    result = CliRunner().invoke(app, ["hard", "--case", "9", "--out", str(tmp_path / "out")])
    assert result.exit_code == 0, result.output
    assert "1 of 1 criteria met" in result.output
    assert len((tmp_path / "out" / "cases.csv").read_text().splitlines()) == 2

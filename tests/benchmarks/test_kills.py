"""kill -9 at random moments of runs, ensembles and their workers; `python -m benchmarks kills` does it 170 times."""

import pytest

from benchmarks import kills


def killed(**counts):
    *_, report = kills.run(kills.Size(**{"runs": 0, "workers": 0, "ensembles": 0} | counts), "quick")
    assert {row["identical"] for row in report.rows} == {"yes"}
    assert sum(row["kills"] for row in report.rows) == sum(counts.values())
    return report


def test_killed_runs_resume_to_the_last_bit():
    report = killed(runs=3)
    assert any(character in "123456789" for row in report.rows for character in row["chunks before a resume"])


@pytest.mark.full
@pytest.mark.filterwarnings("default")
def test_killed_ensembles_resume_to_the_last_bit():
    report = killed(workers=2, ensembles=2)
    assert [row["killed"] for row in report.rows] == ["workers of an ensemble", "ensemble"]

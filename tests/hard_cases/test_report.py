"""Reports of hard cases: a case that raises is a failed row, tables and files say the same, and the command ends
plainly."""

import csv
from functools import partial
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from typer.testing import CliRunner

from vmri_jax.cli import app as vmri
from vmri_jax.hard_cases import Case, Outcome, run_cases
from vmri_jax.hard_cases.case import draw_energy
from vmri_jax.running.progress import Working
from vmri_jax.running.trajectory import Trajectory

RAISES = "bad | luck"


def steady(full: bool) -> Outcome:
    return Outcome("band 0.5", True, {"band": 0.5, "full": full})


def broken(full: bool) -> Outcome:
    raise RuntimeError(RAISES)


CASES = (Case(1, "steady", "a set-up", "a criterion", steady), Case(2, "broken", "another", "no exception", broken))


def test_a_case_that_raises_is_a_failed_row_with_the_reason():
    told = []
    report = run_cases(CASES, full=True, progress=lambda *a: told.append(a))
    assert [row.passed for row in report.rows] == [True, False]
    assert report.rows[1].measured == f"raised RuntimeError: {RAISES}"
    assert report.rows[0].values == {"band": 0.5, "full": 1.0}
    assert not report.passed
    assert told == [("1 steady", 0, 2), ("2 broken", 1, 2), ("done", 2, 2)]


def test_cases_say_which_one_runs_where_nobody_listens(monkeypatch):
    works = []
    monkeypatch.setattr(Working, "__call__", lambda work, what, done, total: works.append(f"{work.name}: {what}"))
    run_cases(CASES)
    assert works == ["check: 1 steady", "check: 2 broken", "check: done"]


def test_numbers_choose_cases_and_unknown_ones_are_refused():
    report = run_cases(CASES, [1])
    assert [row.case.number for row in report.rows] == [1]
    assert report.passed
    with pytest.raises(ValueError, match=r"there is no case 3, 7; they go from 1 to 2"):
        run_cases(CASES, [1, 7, 3])


def test_files_say_what_the_table_says(tmp_path):
    report = run_cases(CASES)
    names = [path.name for path in report.write(tmp_path / "new")]
    assert names == ["cases.csv"]
    first, second = csv.DictReader((tmp_path / "new" / "cases.csv").read_text().splitlines())
    assert (first["verdict"], float(first["band"])) == ("pass", 0.5)
    assert (second["verdict"], second["measured"], second["band"]) == ("fail", f"raised RuntimeError: {RAISES}", "")
    assert report.table().row_count == 2


def test_lines_in_a_pipe_are_no_wider_than_a_page(monkeypatch):
    """A sentence made the table as wide as the sentence is long."""
    monkeypatch.delenv("COLUMNS", raising=False)  # that workers of pytest have
    long = Case(1, "steady", "", "a criterion of many words " * 10, lambda _: Outcome("measured " * 40, True))
    assert max(map(len, str(run_cases([long])).splitlines())) <= 120


def test_pictures_are_drawn_where_a_case_has_one():
    t = np.linspace(0, 1, 1001)
    long = cast(Trajectory, SimpleNamespace(t=t, energy=3.0 + np.sin(50 * t)))

    def run(full: bool) -> Outcome:
        return Outcome("", True, {}, partial(draw_energy, {"": long}))

    report = run_cases([Case(1, "energy for long", "", "", run), CASES[0]])
    [(name, figure)] = report.pictures().items()
    assert name == "energy for long"
    low, high = figure.axes[0].get_ylim()
    assert low < -0.9
    assert high > 0.9


def test_a_case_that_does_not_apply_says_why_and_is_not_missed():
    case = Case(1, "reversal", "", "", broken, does_not_apply="it is driven")
    report = run_cases([case])
    assert report.passed
    assert report.rows[0].verdict == "does not apply"
    assert report.rows[0].measured == "it is driven"


@pytest.mark.compiles
def test_vmri_check_judges_a_system_of_ones_own(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text("from tests.user_systems import two_oscillators as mine\n")
    result = CliRunner().invoke(vmri, ["check", f"{file}:mine", "--case", "2", "--case", "10"])
    assert result.exit_code == 0, result.output
    assert "does not apply" in result.output
    assert "1 of 1 criteria met" in result.output
    assert CliRunner().invoke(vmri, ["check", f"{file}:mine", "--case", "13"]).exit_code == 2

"""Running the cases, and the report: a table, files, pictures."""

import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from rich.text import Text

from vmri_jax import plots
from vmri_jax.hard_cases.case import Case, Outcome
from vmri_jax.hard_cases.cases import cases_for
from vmri_jax.mechanics.state import HasProblem, Problem
from vmri_jax.refusals import Refused
from vmri_jax.running.interrupts import Interrupted
from vmri_jax.running.progress import ShowsProgress, progress_to
from vmri_jax.study.table import Column, ResultTable

COLORS = {"pass": "green", "fail": "red", "does not apply": "dim"}
"""Colour of a verdict."""


@dataclass(frozen=True, repr=False)
class Report(ResultTable):
    """Outcomes of cases, in order."""

    columns = (
        Column("#", lambda row: str(row.case.number)),
        Column("case", lambda row: row.case.title),
        Column("criterion", lambda row: row.case.criterion),
        Column("measured", lambda row: row.measured),
        Column("", lambda row: Text(row.verdict, COLORS[row.verdict])),
        Column("s", lambda row: f"{row.seconds:.1f}", right=True),
    )
    ruled = True
    rows: tuple[Outcome, ...]

    @property
    def missed(self) -> list[Outcome]:
        """The outcomes that do not meet their criterion."""
        return [row for row in self.rows if row.passed is False]

    @property
    def passed(self) -> bool:
        """Whether every criterion is met."""
        return not self.missed

    def records(self) -> list[dict[str, Any]]:
        """Case, verdict and measured values of every row."""
        case, outcome = ("number", "title", "setup", "criterion"), ("measured", "verdict", "seconds")
        of_cases = [{name: getattr(row.case, name) for name in case} for row in self.rows]
        measured = [{name: getattr(row, name) for name in outcome} | dict(row.values) for row in self.rows]
        return [one | other for one, other in zip(of_cases, measured, strict=True)]

    def pictures(self) -> dict[str, Figure]:
        """Figures by the title of the case, for all cases with a picture."""
        return {row.case.title: row.picture() for row in self.rows if row.picture is not None}

    def write(self, folder: str | Path) -> list[Path]:
        """Write cases.csv and the pictures into a folder, made if it does not exist; returns their paths."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        paths = [folder / "cases.csv"]
        self.to_csv(paths[0])
        for title, figure in self.pictures().items():
            paths.append(folder / f"{title.lower().replace(' ', '_')}.png")
            plots.save(figure, paths[-1])
        return paths


def check(
    problem: Problem | HasProblem, numbers: Collection[int] = (), full: bool = False, progress: ShowsProgress = False
) -> Report:
    """Put a system to the hard cases: constraints, energy, tolerance, tiny steps, reversal, batches, bad input.

    Args:
        problem: a `Problem` or a scene; steps are chosen from its frequencies.
        numbers, full, progress: as of `run_cases`.

    Returns:
        The `Report`, an outcome for each case.

    Raises:
        ValueError, Interrupted: as of `run_cases`.
    """
    return run_cases(cases_for(problem), numbers, full, progress)


def run_cases(
    cases: Sequence[Case], numbers: Collection[int] = (), full: bool = False, progress: ShowsProgress = False
) -> Report:
    """Run cases one after the other; a case that raises becomes a failed row with the message of its exception.

    Args:
        cases: e.g. ``cases_for(problem)``.
        numbers: numbers of the cases to run; all cases by default.
        full: whether to run the full form instead of the quick one.
        progress: True for a bar, or a function of (what, done, total), called before every case and at the end; with
            False a case that takes more than two seconds prints a line.

    Raises:
        ValueError: a number that no case has.
        Interrupted: Ctrl-C; carries the report of the finished cases.
    """
    known = [case.number for case in cases]
    unknown = sorted(set(numbers) - set(known))
    if unknown:
        raise Refused(f"run_cases: there is no case {', '.join(map(str, unknown))}; they go from 1 to {max(known)}.")
    chosen, rows = [case for case in cases if not numbers or case.number in numbers], []
    with progress_to("check", progress) as tell:
        for k, case in enumerate(chosen):
            tell(f"{case.number} {case.title}", k, len(chosen))
            start = time.perf_counter()
            try:
                outcome = _outcome(case, full)
            except KeyboardInterrupt:
                raise Interrupted(Report(tuple(rows)), len(rows), len(chosen), "cases") from None
            rows.append(replace(outcome, case=case, seconds=time.perf_counter() - start))
        tell("done", len(chosen), len(chosen))
    return Report(tuple(rows))


def _outcome(case: Case, full: bool) -> Outcome:
    if case.does_not_apply:
        return Outcome(case.does_not_apply, None)
    try:
        return case.run(full)
    except Exception as error:  # the user's functions may raise anything, and the other cases still run
        return Outcome(f"raised {type(error).__name__}: {error}", False)

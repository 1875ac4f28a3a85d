"""Running the cases, and the report: a table, files, pictures."""

import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from vmri_jax import plots
from vmri_jax.hard_cases.case import Case, Outcome
from vmri_jax.hard_cases.cases import cases_for
from vmri_jax.mechanics.state import HasProblem, Problem
from vmri_jax.running.interrupts import Interrupted
from vmri_jax.running.progress import ShowsProgress, progress_to
from vmri_jax.study.table import Column, ResultTable, rich_table

VERDICTS = {True: ("pass", "green"), False: ("fail", "red"), None: ("does not apply", "dim")}


@dataclass(frozen=True)
class Row:
    """A case that was run, with its outcome and its seconds."""

    case: Case
    outcome: Outcome
    seconds: float

    @property
    def verdict(self) -> str:
        """Whether the criterion is met, or the case does not apply."""
        return VERDICTS[self.outcome.passed][0]

    @property
    def missed(self) -> bool:
        """Whether the criterion is not met."""
        return self.outcome.passed is False


NUMBER = Column("#", lambda row: str(row.case.number))
TITLE = Column("case", lambda row: row.case.title)
SETUP = Column("set-up", lambda row: row.case.setup)
CRITERION = Column("criterion", lambda row: row.case.criterion)
MEASURED = Column("measured", lambda row: row.outcome.measured)
VERDICT = Column("", lambda row: Text(*VERDICTS[row.outcome.passed]))
SECONDS = Column("s", lambda row: f"{row.seconds:.1f}", right=True)


@dataclass(frozen=True)
class Report(ResultTable):
    """Cases that were run, in order."""

    columns = (NUMBER, TITLE, SETUP, CRITERION, MEASURED, VERDICT)
    rows: tuple[Row, ...]
    full: bool

    @property
    def passed(self) -> bool:
        """Whether every criterion is met."""
        return not any(row.missed for row in self.rows)

    def records(self) -> list[dict[str, Any]]:
        """All fields of every row but the arrays for its picture."""
        return [
            {
                **{name: getattr(row.case, name) for name in ("number", "title", "setup", "criterion")},
                "measured": row.outcome.measured,
                "passed": row.outcome.passed,
                "values": dict(row.outcome.values),
                "seconds": row.seconds,
            }
            for row in self.rows
        ]

    def lines(self) -> list[dict[str, Any]]:
        """One line per value of a case."""
        return [
            {"number": row.case.number, "case": row.case.title, "verdict": row.verdict, "value": name, "size": size}
            for row in self.rows
            for name, size in row.outcome.values.items()
        ]

    def content(self) -> dict[str, Any]:
        """The rows, and whether these are the full forms."""
        return {"full": self.full, **super().content()}

    def table(self) -> Table:
        """One line per case, for the terminal."""
        return rich_table((NUMBER, TITLE, CRITERION, MEASURED, VERDICT, SECONDS), self.rows, ruled=True)

    def pictures(self, theme: plots.Theme = plots.LIGHT) -> dict:
        """Figures by the title of the case, for all cases with a picture."""
        drawn = [(row.case.title, row.case.draw, row.outcome.details) for row in self.rows]
        return {title: draw(details, theme) for title, draw, details in drawn if draw is not None and details}

    def write(self, folder: str | Path) -> list[Path]:
        """Write cases.md, cases.csv, cases.json and the pictures into a folder, made if it does not exist; returns their paths."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "cases.md").write_text(self.markdown(), encoding="utf-8")
        self.to_csv(folder / "cases.csv")
        self.to_json(folder / "cases.json")
        names = ["cases.md", "cases.csv", "cases.json"]
        for title, figure in self.pictures().items():
            names.append(f"{title.lower().replace(' ', '_')}.png")
            plots.save(figure, folder / names[-1])
        return [folder / name for name in names]


def check(
    problem: Problem | HasProblem, numbers: Collection[int] = (), full: bool = False, progress: ShowsProgress = False
) -> Report:
    """Put a system to the hard cases: constraints, energy, tolerance, tiny steps, reversal, batches, bad input.

    Args:
        problem: a `Problem` or a scene; steps are chosen from its frequencies.
        numbers, full, progress: as of `run_cases`.

    Returns:
        The `Report`, a row for each case; ``print(report.markdown())``.

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
        progress: True for a bar, or a function of (what, done, total), called before every case and at the end; with False a case that takes
            more than two seconds prints a line.

    Raises:
        ValueError: a number that no case has.
        Interrupted: Ctrl-C; carries the report of the finished cases.
    """
    known = [case.number for case in cases]
    unknown = sorted(set(numbers) - set(known))
    if unknown:
        raise ValueError(f"run_cases: there is no case {', '.join(map(str, unknown))}; they go from 1 to {max(known)}.")
    chosen, rows = [case for case in cases if not numbers or case.number in numbers], []
    with progress_to("check", progress) as tell:
        for k, case in enumerate(chosen):
            tell(f"{case.number} {case.title}", k, len(chosen))
            start = time.perf_counter()
            try:
                outcome = _outcome(case, full)
            except KeyboardInterrupt:
                raise Interrupted(Report(tuple(rows), full), len(rows), len(chosen), "cases") from None
            rows.append(Row(case, outcome, time.perf_counter() - start))
        tell("done", len(chosen), len(chosen))
    return Report(tuple(rows), full)


def _outcome(case: Case, full: bool) -> Outcome:
    if case.does_not_apply:
        return Outcome(case.does_not_apply, None)
    try:
        return case.run(full)
    except Exception as error:  # the user's functions may raise anything, and the other cases still run
        return Outcome(f"raised {type(error).__name__}: {error}", False)

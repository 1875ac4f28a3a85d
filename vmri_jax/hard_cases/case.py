"""Hard cases: a set-up, a criterion, a function that measures it; and the report of cases that have run."""

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.text import Text

from vmri_jax import plots
from vmri_jax.refusals import Refused
from vmri_jax.running.interrupts import Interrupted
from vmri_jax.running.progress import ShowsProgress, progress_to
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.study.table import Column, ResultTable

BANDS = 400
"""Pieces of a run for which least and largest error are drawn, about a pixel wide; more pieces make larger files."""
COLORS = {"pass": "green", "fail": "red", "does not apply": "dim"}
"""Colour of a verdict."""


@dataclass(frozen=True)
class Outcome:
    """Result of a case.

    Args:
        measured: the measured values in a sentence.
        passed: whether the criterion is met; None if the case does not apply.
        values: the measured values by name.
        picture: draws a picture of the case; None for none.
        case, seconds: the case and the time that it took, which `run_cases` notes.
    """

    measured: str
    passed: bool | np.bool | None
    values: Mapping[str, Any] = field(default_factory=dict)
    picture: Callable[[], Figure] | None = None
    case: "Case" = None  # pyright: ignore[reportAssignmentType] (every row of a report has one)
    seconds: float = 0.0

    def __post_init__(self):
        object.__setattr__(self, "passed", None if self.passed is None else bool(self.passed))
        object.__setattr__(self, "values", {name: float(value) for name, value in self.values.items()})

    @property
    def verdict(self) -> str:
        """Whether the criterion is met, or the case does not apply."""
        return "does not apply" if self.passed is None else "pass" if self.passed else "fail"


@dataclass(frozen=True)
class Case:
    """One hard case.

    Args:
        number: number of the case in the list.
        title: title of a few words.
        setup: the run or the comparison, in a sentence.
        criterion: the condition for a pass, in a sentence.
        run: ``run(full) -> Outcome``, the full form of the case or a quick one.
        does_not_apply: the reason why the case is meaningless for the system; empty if it is meaningful.
    """

    number: int
    title: str
    setup: str
    criterion: str
    run: Callable[[bool], Outcome]
    does_not_apply: str = ""


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
                outcome = Outcome(case.does_not_apply, None) if case.does_not_apply else case.run(full)
            except KeyboardInterrupt:
                raise Interrupted(Report(tuple(rows)), len(rows), len(chosen), "cases") from None
            except Exception as error:  # the user's functions may raise anything, and the other cases still run
                outcome = Outcome(f"raised {type(error).__name__}: {error}", False)
            rows.append(replace(outcome, case=case, seconds=time.perf_counter() - start))
        tell("done", len(chosen), len(chosen))
    return Report(tuple(rows))


def draw_energy(runs: Mapping[str, Trajectory]) -> Figure:
    """Energy error against time, for every run by its label the band between its least and largest error."""
    with plots.new_figure(7.2, 3.2, "", plots.LIGHT) as figure:
        axes = figure.subplots()
        for (label, run), color in zip(runs.items(), plots.LIGHT.curves, strict=False):
            t, e = np.asarray(run.t), np.asarray(run.energy) - run.energy[0]
            starts = np.arange(0, len(t), max(1, len(t) // BANDS))
            low, high = np.minimum.reduceat(e, starts), np.maximum.reduceat(e, starts)
            axes.fill_between(t[starts], low, high, color=color, alpha=0.8, lw=0.6, label=label or None)
        axes.set(xlabel="time", ylabel=r"energy error $E - E_0$", xlim=(0, t[-1]))
        if len(runs) > 1:
            axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure

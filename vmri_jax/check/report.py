"""Running cases, and what came out: a table, files, pictures."""

import csv
import json
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.markup import escape
from rich.table import Table

from vmri_jax import plots
from vmri_jax.hard.case import Case, Outcome
from vmri_jax.hard.pictures import pictures
from vmri_jax.study.table import Progress, silent


@dataclass(frozen=True)
class Row:
    """A case that was run: what came out, and how long it took."""

    case: Case
    outcome: Outcome
    seconds: float

    @property
    def verdict(self) -> str:
        return "pass" if self.outcome.passed else "fail"


@dataclass(frozen=True)
class Report:
    """Cases that were run, in order."""

    rows: tuple[Row, ...]
    full: bool

    @property
    def passed(self) -> bool:
        """Whether every criterion is met."""
        return all(row.outcome.passed for row in self.rows)

    def table(self) -> Table:
        """One line per case, for the terminal."""
        table = Table("#", "case", "criterion", "measured", "", "s", show_lines=True)
        for row in self.rows:
            color = "green" if row.outcome.passed else "red"
            cells = (str(row.case.number), row.case.title, row.case.criterion, row.outcome.measured)
            table.add_row(*map(escape, cells), f"[{color}]{row.verdict}[/{color}]", f"{row.seconds:.1f}")
        return table

    def markdown(self) -> str:
        """One line per case, for a README."""
        lines = ["| # | case | set-up | criterion | measured | |", "|---|---|---|---|---|---|"]
        for row in self.rows:
            case, measured = row.case, row.outcome.measured
            cells = (str(case.number), case.title, case.setup, case.criterion, measured, row.verdict)
            lines.append("| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |")
        return "\n".join(lines) + "\n"

    def to_csv(self, path: str | Path) -> None:
        """Write one line per value of a case."""
        with open(path, "w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["number", "case", "verdict", "value", "size"])
            for row in self.rows:
                for name, value in row.outcome.values.items():
                    writer.writerow([row.case.number, row.case.title, row.verdict, name, repr(value)])

    def to_json(self, path: str | Path) -> None:
        """Write everything but the arrays; values that are not finite as strings."""
        rows = [
            {
                "number": row.case.number,
                "title": row.case.title,
                "setup": row.case.setup,
                "criterion": row.case.criterion,
                "measured": row.outcome.measured,
                "passed": row.outcome.passed,
                "values": {k: v if abs(v) < float("inf") else str(v) for k, v in row.outcome.values.items()},
                "seconds": row.seconds,
            }
            for row in self.rows
        ]
        Path(path).write_text(json.dumps({"full": self.full, "rows": rows}, indent=1))

    def pictures(self, theme: plots.Theme = plots.LIGHT) -> dict:
        """Figures by name, of the cases that have one."""
        return pictures({row.case.title: row.outcome.details for row in self.rows}, theme)

    def write(self, folder: str | Path) -> list[Path]:
        """Write cases.md, cases.csv, cases.json and the pictures into a folder, which is made; returns what was written."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "cases.md").write_text(self.markdown(), encoding="utf-8")
        self.to_csv(folder / "cases.csv")
        self.to_json(folder / "cases.json")
        names = ["cases.md", "cases.csv", "cases.json"]
        for name, figure in self.pictures().items():
            plots.save(figure, folder / f"{name}.png")
            names.append(f"{name}.png")
        return [folder / name for name in names]


def run_cases(
    numbers: Collection[int] | None = None,
    full: bool = False,
    progress: Progress | None = None,
    cases: Sequence[Case] | None = None,
) -> Report:
    """Run cases one after the other; one that raises is a failed row with the reason.

    Args:
        numbers: which ones; all by default.
        full: the full form instead of the quick one.
        progress: called before every case and at the end.
        cases: those of `catalogue` by default, or e.g. ``cases_for(problem)``.

    Raises:
        ValueError: a number that no case has.
    """
    from vmri_jax.hard import catalogue

    cases, progress = catalogue() if cases is None else cases, progress or silent
    known = [case.number for case in cases]
    unknown = sorted(set(numbers or ()) - set(known))
    if unknown:
        raise ValueError(f"run_cases: there is no case {', '.join(map(str, unknown))}; they go from 1 to {max(known)}.")
    chosen, rows = [case for case in cases if not numbers or case.number in numbers], []
    for k, case in enumerate(chosen):
        progress(f"{case.number} {case.title}", k, len(chosen))
        start = time.perf_counter()
        try:
            outcome = case.run(full)
        except Exception as error:
            outcome = Outcome(f"raised {type(error).__name__}: {error}", False)
        rows.append(Row(case, outcome, time.perf_counter() - start))
    progress("done", len(chosen), len(chosen))
    return Report(tuple(rows), full)

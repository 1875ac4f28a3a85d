"""Work and precision: errors of runs against their time and their evaluations, and the Pareto front of all runs."""

from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np

from vmri_jax import plots
from vmri_jax.mechanics.terms import label
from vmri_jax.study.reference_solution import ReferenceSolution
from vmri_jax.study.row import Row, RunTable
from vmri_jax.study.table import Column


def duration(seconds: float) -> str:
    """A time with its unit: 12 µs, 3.4 ms, 1.2 s; empty for NaN."""
    if np.isnan(seconds):
        return ""
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 1e-6:.2g} µs"


@dataclass(frozen=True, repr=False)
class WorkPrecision(RunTable):
    """Runs by their errors and their work; its table is the Pareto front.

    reference: the solution that errors are measured against; None for a search, whose errors are estimated by companion runs.
    """

    columns = (
        Column("scheme", lambda row: row.scheme),
        Column("H", lambda row: f"{row.macro_dt:.4g}", right=True),
        Column("steps", lambda row: f"{row.num_steps:,}", right=True),
        Column("error of q", lambda row: f"{row.error_q:.1e}", right=True),
        Column("time", lambda row: duration(row.seconds), right=True),
        Column("grad V", lambda row: f"{row.slow_evaluations:,}", right=True),
        Column("grad W", lambda row: f"{row.fast_evaluations:,}", right=True),
        Column("further gradients", lambda row: ", ".join(f"{label(k)} {n:,}" for k, n in row.evaluations.items())),
        Column("solves", lambda row: f"{row.solves:,}", right=True),
    )
    rows: tuple[Row, ...]
    reference: ReferenceSolution | None = None

    @property
    def known_to(self) -> float:
        """Error of the positions of the reference; 0 without one."""
        return 0.0 if self.reference is None else self.reference.error_q

    def curve(self, scheme: str) -> list[Row]:
        """The runs of a scheme that did not fail, the coarsest first."""
        return [row for row in self.rows if row.scheme == scheme and not row.failed]

    def pareto(self, work: str = "seconds") -> list[Row]:
        """The runs that no other one beats both in error and in work, the cheapest first.

        Args:
            work: "seconds", "slow_evaluations", "fast_evaluations" or "solves".
        """
        return pareto_front(self.rows, work, "error_q")

    def keeping(self, error: float) -> list[Row]:
        """The runs that keep an error of the positions and whose time is known, the fastest first."""
        kept = [row for row in self.rows if row.error_q <= error and np.isfinite(row.seconds)]
        return sorted(kept, key=attrgetter("seconds"))

    def shown(self) -> list[Row]:
        """The Pareto front, by numbers of steps where no run has a time."""
        return self.pareto() or self.pareto("num_steps")

    def plot(self, title: str = "", work: str = "seconds"):
        """Error against work, see `vmri_jax.plots.plot_work_precision`."""
        return plots.plot_work_precision(self, title, work)


def pareto_front(items: Sequence[Any], work: str, error: str) -> list[Any]:
    """The items that no other item beats both in the attribute `work` and in the attribute `error`, the cheapest first."""
    front, finite = [], [item for item in items if np.isfinite([getattr(item, error), getattr(item, work)]).all()]
    for item in sorted(finite, key=attrgetter(work, error)):
        if not front or getattr(item, error) < getattr(front[-1], error):
            front.append(item)
    return front

"""A hard case: a set-up, a criterion, a function that measures it; and the picture of the energy of a long run."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from vmri_jax import plots
from vmri_jax.running.trajectory import Trajectory

BANDS = 400
"""Pieces of a run for which least and largest error are drawn, about a pixel wide; more pieces make larger files."""


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

"""A hard case: a set-up, a criterion, a function that measures it, and the picture of a long run: its energy error as a
band."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from matplotlib.figure import Figure

from vmri_jax import plots

BANDS = 400
"""Pieces of a run for which least and largest error are drawn, about a pixel wide; more pieces make larger files."""
Details = Mapping[str, np.ndarray]
"""Arrays for the picture of a case, by name."""


@dataclass(frozen=True)
class Outcome:
    """Result of a case.

    Args:
        measured: the measured values in a sentence.
        passed: whether the criterion is met; None if the case does not apply.
        values: the measured values by name.
        details: arrays for the picture of the case.
        case, seconds: the case and the time that it took, which `run_cases` notes.
    """

    VERDICTS: ClassVar = {True: "pass", False: "fail", None: "does not apply"}
    measured: str
    passed: bool | np.bool | None
    values: Mapping[str, Any] = field(default_factory=dict)
    details: Mapping[str, Any] = field(default_factory=dict)
    case: "Case" = None  # pyright: ignore[reportAssignmentType] (every row of a report has one)
    seconds: float = 0.0

    def __post_init__(self):
        object.__setattr__(self, "passed", None if self.passed is None else bool(self.passed))
        object.__setattr__(self, "values", {name: float(value) for name, value in self.values.items()})
        object.__setattr__(self, "details", {name: np.asarray(value) for name, value in self.details.items()})

    @property
    def verdict(self) -> str:
        """Whether the criterion is met, or the case does not apply."""
        return self.VERDICTS[self.passed]


@dataclass(frozen=True)
class Case:
    """One hard case.

    Args:
        number: number of the case in the list.
        title: title of a few words.
        setup: the run or the comparison, in a sentence.
        criterion: the condition for a pass, in a sentence.
        run: ``run(full) -> Outcome``, the full form of the case or a quick one.
        draw: ``draw(details, theme)`` makes its picture; None if it has none.
        does_not_apply: the reason why the case is meaningless for the system; empty if it is meaningful.
    """

    number: int
    title: str
    setup: str
    criterion: str
    run: Callable[[bool], Outcome]
    draw: Callable[[Details, plots.Theme], Figure] | None = None
    does_not_apply: str = ""


def draw_energy(details: Details, theme: plots.Theme) -> Figure:
    """Energy error against time, for every run the band between its least and largest error."""
    runs = [name.removeprefix("t") for name in details if name == "t" or name.startswith("t ")]
    with plots.new_figure(7.2, 3.2, "", theme) as figure:
        axes = figure.subplots()
        for name, color in zip(runs, theme.curves, strict=False):
            t, e = details[f"t{name}"], details[f"energy error{name}"]
            starts = np.arange(0, len(t), max(1, len(t) // BANDS))
            low, high = np.minimum.reduceat(e, starts), np.maximum.reduceat(e, starts)
            label = f"tolerance {name.strip()}" if name else None
            axes.fill_between(t[starts], low, high, color=color, alpha=0.8, lw=0.6, label=label)
        axes.set(xlabel="time", ylabel=r"energy error $E - E_0$", xlim=(0, details[f"t{runs[0]}"][-1]))
        if len(runs) > 1:
            axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure

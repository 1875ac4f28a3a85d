"""A hard case: a set-up, a criterion, and a function that measures it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from vmri_jax.plots import Theme

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
    """

    measured: str
    passed: bool | np.bool | None
    values: Mapping[str, Any] = field(default_factory=dict)
    details: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self):
        object.__setattr__(self, "passed", None if self.passed is None else bool(self.passed))
        object.__setattr__(self, "values", {name: float(value) for name, value in self.values.items()})
        object.__setattr__(self, "details", {name: np.asarray(value) for name, value in self.details.items()})


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
    draw: Callable[[Details, Theme], Figure] | None = None
    does_not_apply: str = ""

"""A hard case: a set-up, a criterion, and a function that measures it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from vmri_jax.plots import Theme

Details = Mapping[str, np.ndarray]
"""Arrays that a picture is drawn from, by name."""


@dataclass(frozen=True)
class Outcome:
    """What a case measured.

    Args:
        measured: the figures in a sentence.
        passed: whether the criterion is met; None if the case does not apply.
        values: the figures by name.
        details: arrays that the picture of the case is drawn from.
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
        number: its place in the list.
        title: a few words.
        setup, criterion: a sentence each: what is run, and what counts as a pass.
        run: ``run(full) -> Outcome``, a quick form or the full one.
        draw: ``draw(details, theme)`` makes its picture, if it has one.
        does_not_apply: why the case has no sense for the system; empty where it has.
    """

    number: int
    title: str
    setup: str
    criterion: str
    run: Callable[[bool], Outcome]
    draw: Callable[[Details, Theme], Figure] | None = None
    does_not_apply: str = ""

"""A hard case: a set-up, a criterion, and a function that measures it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Outcome:
    """What a case measured.

    Args:
        measured: the figures in a sentence.
        passed: whether the criterion is met.
        values: the figures by name.
        details: arrays that pictures are drawn from, by name.
    """

    measured: str
    passed: bool | np.bool
    values: Mapping[str, Any] = field(default_factory=dict)
    details: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self):
        object.__setattr__(self, "passed", bool(self.passed))
        object.__setattr__(self, "values", {name: float(value) for name, value in self.values.items()})
        object.__setattr__(self, "details", {name: np.asarray(value) for name, value in self.details.items()})


@dataclass(frozen=True)
class Case:
    """One hard case.

    Args:
        number: its place in the catalogue.
        title: a few words.
        setup, criterion: a sentence each: what is run, and what counts as a pass.
        run: ``run(full) -> Outcome``, a quick form or the full one.
    """

    number: int
    title: str
    setup: str
    criterion: str
    run: Callable[[bool], Outcome]

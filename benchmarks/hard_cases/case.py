"""A hard case is the function that measures it."""

import inspect
from collections.abc import Callable

import numpy as np

from vmri_jax.hard_cases import Case, Outcome
from vmri_jax.running.trajectory import Trajectory


def iterations(trajectory: Trajectory) -> int:
    """The most iterations of a step."""
    return int(np.max(np.asarray(trajectory.info.iterations)))


def hard_case(title: str) -> Callable[..., Case]:
    """Makes a `Case` of ``run(full)``, whose docstring is the set-up, an empty line and the criterion; the catalogue numbers it."""

    def made(run: Callable[[bool], Outcome]) -> Case:
        setup, criterion = inspect.cleandoc(run.__doc__ or "").split("\n\n")
        return Case(0, title, setup, criterion, run)

    return made

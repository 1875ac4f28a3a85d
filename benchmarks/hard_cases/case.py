"""A hard case is the function that measures it."""

import inspect
from collections.abc import Callable

from vmri_jax.hard_cases import Case, Outcome


def hard_case(number: int, title: str, draw=None) -> Callable[..., Case]:
    """Makes a `Case` of ``run(full)``, whose docstring is the set-up, an empty line and the criterion."""

    def made(run: Callable[[bool], Outcome]) -> Case:
        setup, criterion = inspect.cleandoc(run.__doc__ or "").split("\n\n")
        return Case(number, title, setup, criterion, run, draw)

    return made

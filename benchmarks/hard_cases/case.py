"""A hard case is the function that measures it, with its set-up and its criterion."""

from collections.abc import Callable

from vmri_jax.check import Case, Outcome


def hard_case(number: int, title: str, setup: str, criterion: str, draw=None) -> Callable[..., Case]:
    """Makes a `Case` of ``run(full)``; arguments as of `Case`."""

    def made(run: Callable[[bool], Outcome]) -> Case:
        return Case(number, title, setup, criterion, run, draw)

    return made

"""The doors of the search for an accuracy: checks of arguments, the usual menu, warnings about runs that miss it."""

import warnings

import numpy as np

from vmri_jax.accuracy.companions import fewest_steps
from vmri_jax.accuracy.families import Family, for_system, of_scheme, two_families
from vmri_jax.accuracy.search import MOST_COORDINATES, Search, Trial
from vmri_jax.mechanics.checks import check_number, check_type
from vmri_jax.mechanics.invariants import velocity
from vmri_jax.mechanics.state import Problem, State
from vmri_jax.refusals import Refused
from vmri_jax.schemes.composition import SchemeLike

MANY_STEPS = 100_000
"""Macro steps that short events demand, above which a warning tells of them; a smaller value warns of fast runs."""
ROUNDOFF = 100 * np.finfo(float).eps
"""Error refused as round-off, as a part of the largest position; a larger value refuses reachable accuracies."""


class AccuracyNotReached(UserWarning):
    """The error of a run exceeds its accuracy, or is not certified."""


def with_accuracy(search: Search, scheme: SchemeLike | None, accuracy: float) -> Trial:
    """The trial whose largest estimated error of a position is at most `accuracy`, with a scheme of the user or with
    one of the usual menu; warns with `AccuracyNotReached` if no trial is as accurate."""
    a_scheme = "a Scheme, e.g. fully_implicit(num_micro=10), or None"
    check_type("simulate: scheme", scheme, SchemeLike | None, a_scheme)
    check_error("simulate: accuracy", accuracy, search.start)
    best = reached("simulate: accuracy", search, usual_menu(search, scheme, accuracy), accuracy)[0]
    warn_of_events("simulate", search, best.run.scheme, stacklevel=4)
    if not best.error <= accuracy:
        uncertified = "no error is certified over its length"
        reached_error = f"its error is {best.error:.1e}" if np.isfinite(best.error) else uncertified
        warnings.warn(
            f"simulate: accuracy {accuracy:g} is not reached with {best.run.num_steps} macro steps, {reached_error}; "
            "give a shorter t_end, a larger accuracy, or another scheme.",
            AccuracyNotReached,
            stacklevel=3,
        )
    return best


def reached(name: str, search: Search, menu: list[Family], accuracy: float, **how) -> list[Trial]:
    """`Search.cheapest` of an accuracy, which is refused if no position moves as far; `name` begins the message."""
    search.first_trials(menu, accuracy)
    check_extent(name, search, accuracy)
    return search.cheapest(menu, accuracy, **how)


def check_extent(name: str, search: Search, accuracy: float) -> None:
    """Refuse an accuracy above the extent of the motion in the first trials."""
    extent = search.extent()
    # Driven systems: positions at few saved nodes may hide the motion, and all trials see the events.
    if accuracy > extent and not search.drives.names:
        moves = f"no position moves by more than {extent:.3g} until t = {search.t_end:g}: any run is as accurate"
        raise Refused(f"{name} is {accuracy:g}, and {moves}; give a smaller one.")


def usual_menu(search: Search, scheme: SchemeLike | None, accuracy: float) -> list[Family]:
    """The families for an accuracy: the user's scheme alone, or kicks and a single interval of high degree."""
    if scheme is not None:
        return [of_scheme(scheme)]
    size = search.start.q_s.size + search.start.q_f.size
    menu = two_families(search.system, size, digits_of(search, accuracy), MOST_COORDINATES)
    return for_system(menu, search.system, search.has_two_rates)


def digits_of(search: Search, accuracy: float) -> float:
    """The digits of an accuracy, at least one, relative to the largest position, or largest speed times length."""
    start = search.start
    q, v = (start.q_s, start.q_f), velocity(search.system, start.q_s, start.q_f, start.p_s, start.p_f)
    size, speed = (max(np.abs(np.asarray(a)).max(initial=0.0) for a in pair) for pair in (q, v))
    return float(np.log10(max((size or speed * search.length) / accuracy, 10.0)))


def warn_of_events(caller: str, search: Search, scheme: SchemeLike, stacklevel: int) -> None:
    """Warn if the events of a driven system demand `MANY_STEPS` of a run."""
    drives, fewest = search.drives, fewest_steps(scheme, search.drives, search.length)
    if fewest > MANY_STEPS:
        warnings.warn(
            f"{caller}: {' and '.join(drives.names)} of the system changes and changes back within "
            f"{drives.shortest:.2g}, so that the run takes at least {fewest} macro steps until "
            f"t = {search.t_end:g}; a run in parts, with its steps for each part, takes fewer.",
            stacklevel=stacklevel,
        )


def check_error(name: str, error: float, start: State | Problem) -> None:
    """Refuse errors of positions that round-off hides; `name` begins the message."""
    check_number(name, error)
    size, floor = round_off(start)
    if not error > floor:
        round_off_of = f"the largest position is {size:.3g}, so that round-off of float64 alone is about {floor:.0e}"
        raise Refused(f"{name} is {error:g}; {round_off_of}. Give a larger one, in the unit of the positions.")


def round_off(start: State | Problem) -> tuple[float, float]:
    """The largest position at the start, and the error of positions that round-off alone causes in a run."""
    size = max(float(np.abs(np.asarray(q)).max(initial=0.0)) for q in (start.q_s, start.q_f))
    return size, ROUNDOFF * size

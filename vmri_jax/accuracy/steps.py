"""Steps for an accuracy: macro step and num_micro of a scheme, and the scheme from a small menu, from the errors of trial runs.

A trial is a run over the whole time with large macro steps, and a companion run with half the macro step; both give the error e of the trial,
see `vmri_jax.accuracy.companions`. A scheme of order p has an error of at most ``eps`` with

    n = n_trial (e / eps)^(1 / p)

macro steps. A macro step of N micro steps takes the time ``a + b N`` and makes an error with the shares ``S H^p`` (slow) and
``F (H/N)^p`` (fast). The least time for a given error is reached with

    N^(p + 1) = (a / b) (F / S).

Then the times on both grids have the ratio of the error shares, ``a / (b N) = S / (F / N^p)``.
"""

import warnings
from collections.abc import Callable

import numpy as np

from vmri_jax.accuracy.companions import check_function_of_run, extent_of, fewest_steps
from vmri_jax.accuracy.families import Family, of_degree, of_order_2
from vmri_jax.accuracy.trials import AIMED_PART, MOST_SAVED, MOST_STEPS, Search, Trial, unit_of
from vmri_jax.mechanics.arrays import is_concrete
from vmri_jax.mechanics.checks import check_number, check_type
from vmri_jax.mechanics.driving import events
from vmri_jax.mechanics.invariants import velocity
from vmri_jax.mechanics.masses import ConstantMass
from vmri_jax.mechanics.state import Movable, Problem, State, start_of
from vmri_jax.mechanics.system import System
from vmri_jax.running.arguments import Steps
from vmri_jax.running.memory import check_memory
from vmri_jax.running.progress import Progress, silent
from vmri_jax.running.settings import Settings
from vmri_jax.running.simulation import Simulation, simulation
from vmri_jax.schemes.composition import Composition, stage_scheme
from vmri_jax.schemes.scheme import Scheme, fully_explicit, fully_implicit
from vmri_jax.steppers.solver import Solver

FIRST_MICRO = 5
"""Micro steps of the first trials; the search then chooses another number. One far from the best number makes the trials take longer."""
MOST_COORDINATES = 60
"""Most coordinates of a system for which a single interval of high degree is tried, and for which resonances are looked up. The matrices of
both have a row for each coordinate: with 200 of them they take minutes, and schemes with kicks are faster."""
MOST_GROWTH = 64
"""Most steps of a run over the steps of the run before. With a larger number a search whose accuracy is out of reach, as with jumps of forces, ends with
fewer steps than it could take; with a smaller one it repeats runs more often."""
MANY_STEPS = 100_000
"""Macro steps that short events demand, above which a warning tells of them; a smaller value warns of runs that take less than a second."""
MOST_REPEATS = 5
"""Runs that may miss the accuracy before the search gives up; a larger value makes searches for an accuracy out of reach take longer."""
RESONANT_GROWTH = 1e-6
"""Growth of disturbances per macro step above which a step is resonant, see `vmri_jax.stability.advise`; a larger value accepts steps of
weak resonances."""
SHORTER_STEPS = (1.0, 0.98, 0.96, 0.93, 0.9, 0.86, 0.82, 0.78)
"""Macro steps that are tried in this order until one is not resonant, in units of the largest step for the accuracy."""


COMPOSED = ((2.5, None), (5.0, "suzuki4"), (8.0, "kahan-li6"), (np.inf, "kahan-li8"))
"""(most digits, composition): the composition for an accuracy of at most this number of digits. Higher orders need fewer steps for many digits, and
more steps for few."""
ROUNDOFF = 100 * np.finfo(float).eps
"""Error below which an accuracy is refused as round-off, as a part of the largest position; a larger value refuses reachable accuracies."""


class AccuracyNotReached(UserWarning):
    """The error of a run exceeds its accuracy, or is not certified."""


def with_accuracy(
    system: Movable,
    scheme: Scheme | Composition | None,
    state: State | None,
    solver: Solver | None,
    accuracy: float,
    *,
    t_end: float,
    num_saves: int | None,
    of: Callable | None = None,
    progress: Progress = silent,
) -> tuple[Trial, Settings]:
    """The trial whose largest estimated error of a position is at most `accuracy`, and its settings.

    Warns with `AccuracyNotReached` if no trial is as accurate. Arguments are as of `vmri_jax.simulate`.

    Raises:
        TypeError: scheme is not a scheme.
        ValueError: an accuracy below round-off, or above the extent of the motion; arguments that `vmri_jax.simulate` refuses.
    """
    a_scheme = "a Scheme, e.g. fully_implicit(num_micro=10), or None"
    check_type("simulate: scheme", scheme, Scheme | Composition | None, a_scheme)
    opened_system, start = start_of("simulate", system, state)
    if not is_concrete((vars(start), opened_system.params, t_end)):
        raise ValueError(
            "simulate: an accuracy compares runs with numbers; call simulate outside of jax.jit, vmap and grad."
        )
    length = float(t_end - start.t)
    check_error("simulate: accuracy", accuracy, start)
    if not length > 0:
        raise ValueError(f"simulate: t_end is {length:g} after the start; it must be later.")

    def make(scheme: Scheme | Composition) -> Simulation:
        run = simulation(system, scheme, state, solver, Steps(length, num_steps=1))
        run.check()
        check_memory("simulate", run.state, scheme.num_micro, num_saves or MOST_SAVED, False)
        check_function_of_run(of, True, run)
        return run

    drives = events(opened_system, start, t_end)
    search = Search(make, length, num_saves, progress, drives)
    menu = _menu(scheme, opened_system, start, accuracy, length)
    trials = search.first_trials(menu)
    extent = max(extent_of(trial.trajectory) for trial in trials)
    # Driven systems: positions at few saved nodes may hide the motion, and all trials see the events.
    if accuracy > extent and not drives.names:
        raise ValueError(
            f"simulate: accuracy is {accuracy:g}, and no position moves by more than {extent:.3g} until t = {t_end:g}: any run is as "
            "accurate. Give a smaller one, in the unit of the positions."
        )
    best = min(trials, key=lambda trial: trial.time_for(AIMED_PART * accuracy))
    # A single interval of high degree (above 1) stays single: it resolves the fast variables by its degree.
    can_choose = micro_steps_help(opened_system, start) and stage_scheme(best.run.scheme).degree == 1
    if can_choose and np.isfinite(best.error) and best.error > 0:
        best = search.with_best_num_micro(best, accuracy)
    best = _accurate(search, best, accuracy)
    fewest = fewest_steps(best.run.scheme, drives, length)
    if fewest > MANY_STEPS:
        warnings.warn(
            f"simulate: {' and '.join(drives.names)} of the system changes and changes back within {drives.shortest:.2g}, so that the run takes "
            f"at least {fewest} macro steps until t = {t_end:g}; a run in parts, with its steps for each part, takes fewer.",
            stacklevel=3,
        )
    if not best.error <= accuracy:
        uncertified = "no error is certified over its length"
        reached = f"its error is {best.error:.1e}" if np.isfinite(best.error) else uncertified
        warnings.warn(
            f"simulate: accuracy {accuracy:g} is not reached with {best.run.num_steps} macro steps, {reached}; give a shorter t_end, a "
            "larger accuracy, or another scheme.",
            AccuracyNotReached,
            stacklevel=3,
        )
    numbers = float(best.run.macro_dt), best.run.num_steps, best.run.save_every
    python = best.family.python.format(best.num_micro)
    gain, time = 1.0, search.relative_time
    if time is not None and best.num_micro > 1:
        gain = time(1) / time(best.num_micro)
    return best, Settings(best.run.scheme, python, best.family.options, *numbers, gain)


def _accurate(search: Search, best: Trial, accuracy: float) -> Trial:
    """A trial of the scheme of `best` with an error of at most `accuracy`, or the last trial if `MOST_REPEATS` of them miss it."""
    fewest, order = 1, 1.0 if search.drives.jump else float(best.run.order)
    for _ in range(MOST_REPEATS):
        if not np.isfinite(best.error):
            break
        wanted = min(best.steps_for(AIMED_PART * accuracy, order), MOST_GROWTH * best.run.num_steps)
        num_steps = _beside_resonances(search, best, max(wanted, fewest))
        if num_steps > max(MOST_STEPS, fewest_steps(best.run.scheme, search.drives, search.length)):
            break
        before, best = best, search.trial(best.family, best.num_micro, num_steps, best.run.may_fall_back, accuracy)
        if best.error <= accuracy:
            break
        fewest = best.run.num_steps + 1
        # Kinks of a force lower the order: later runs take the order between the last two.
        falls, grows = np.log(before.error / best.error), np.log(best.run.num_steps / before.run.num_steps)
        order = float(np.clip(falls / grows, 1.0, best.run.order)) if grows > 0 else 1.0
    return best


def check_error(name: str, error: float, start: State | Problem) -> None:
    """Refuse errors of positions that round-off hides; `name` begins the message."""
    check_number(name, error)
    size, floor = round_off(start)
    if not error > floor:
        raise ValueError(
            f"{name} is {error:g}; the largest position is {size:.3g}, so that round-off of float64 alone is about {floor:.0e}. "
            "Give a larger one, in the unit of the positions."
        )


def round_off(start: State | Problem) -> tuple[float, float]:
    """The largest position at the start, and the error of positions that round-off alone causes in a run."""
    size = max(float(np.abs(np.asarray(q)).max(initial=0.0)) for q in (start.q_s, start.q_f))
    return size, ROUNDOFF * size


def _menu(scheme, system: System, start: State, accuracy: float, length: float) -> list[tuple[Family, int]]:
    """Families to try, with their first numbers of micro steps.

    The user's scheme is the only one on its menu. Else there are two: kicks (the midpoint rule if masses depend on the configuration),
    composed to an order of about the number of digits of the accuracy; and a single interval of high degree.
    """
    if scheme is not None:
        family = Family("own", scheme.with_num_micro, "", "scheme.with_num_micro({})")
        return [(family, stage_scheme(scheme).num_micro)]
    q, v = (start.q_s, start.q_f), velocity(system, start.q_s, start.q_f, start.p_s, start.p_f)
    size, speed = (max(np.abs(np.asarray(a)).max(initial=0.0) for a in pair) for pair in (q, v))
    digits = np.log10(max((size or speed * length) / accuracy, 10.0))
    base = of_order_2(fully_explicit if isinstance(system.kinetic, ConstantMass) else fully_implicit)
    name = next((name for most, name in COMPOSED if digits <= most), None)
    unit = unit_of(system, stage_scheme(base.make(1)))
    num_micro = unit * -(-FIRST_MICRO // unit) if micro_steps_help(system, start) else 1
    kicks = base if name is None else base.composed(name), num_micro
    single = of_degree(int(np.clip(np.ceil(digits), 2, 8))), 1
    # A single micro interval cannot carry a rule on every k-th micro node.
    has_single = unit == 1 and start.q_s.size + start.q_f.size <= MOST_COORDINATES
    return [kicks, single] if has_single else [kicks]


def micro_steps_help(system: System, start: State) -> bool:
    """Whether micro steps may save time: the system has fast coordinates, and slow coordinates or potentials for the macro grid."""
    return bool(start.q_f.size and (start.q_s.size or system.slow_potential is not None or system.potentials))


def _beside_resonances(search: Search, trial: Trial, num_steps: int) -> int:
    """This number of macro steps, or the next larger number for which small motions about the start do not grow."""
    # Imported here, since vmri_jax.stability imports matplotlib, which takes half a second.
    from vmri_jax.stability.linear import small_motions
    from vmri_jax.stability.multipliers import multipliers

    start = trial.run.state
    if trial.num_micro == 1 or start.q_s.size + start.q_f.size > MOST_COORDINATES:
        return num_steps
    try:
        motions = small_motions(trial.run.system, trial.run.state)
    except ValueError:  # no small motions: a mechanism whose drives prescribe all of its coordinates
        return num_steps
    numbers = [search.rounded(int(np.ceil(num_steps / shorter)))[0] for shorter in SHORTER_STEPS]
    radii = multipliers(motions, trial.run.scheme, [search.length / n for n in numbers]).radius
    return next((n for n, radius in zip(numbers, radii, strict=True) if radius <= 1 + RESONANT_GROWTH), num_steps)

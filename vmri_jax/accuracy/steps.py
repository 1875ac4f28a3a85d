"""Steps for an accuracy: macro step and num_micro of a scheme, and the scheme from a small menu, from the errors of trial runs.

A trial is a run over the whole time with large macro steps, and a companion run with half the macro step; both give the error e of the trial,
see `vmri_jax.accuracy.companions`. A scheme of order p has an error of at most ``eps`` with

    n = n_trial (e / eps)^(1 / p)

macro steps. A macro step of N micro steps takes the time ``a + b N`` and makes an error with the shares ``S H^p`` (slow) and
``F (H/N)^p`` (fast). The least time for a given error is reached with

    N^(p + 1) = (a / b) (F / S).

Then the times on both grids have the ratio of the error shares, ``a / (b N) = S / (F / N^p)``.
"""

import math
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from vmri_jax.accuracy.companions import certified_nodes, check_function_of_run, companion, extent_of, extrapolated
from vmri_jax.accuracy.families import Family, of_degree, of_order_2
from vmri_jax.mechanics.arrays import is_concrete
from vmri_jax.mechanics.checks import check_number
from vmri_jax.mechanics.invariants import velocity
from vmri_jax.mechanics.masses import ConstantMass
from vmri_jax.mechanics.state import Movable, State, start_of
from vmri_jax.mechanics.system import System
from vmri_jax.running.arguments import Steps
from vmri_jax.running.memory import check_memory
from vmri_jax.running.progress import Progress, silent
from vmri_jax.running.run_error import largest_of
from vmri_jax.running.settings import Settings
from vmri_jax.running.simulation import Simulation, simulation
from vmri_jax.running.timing import least_seconds
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.schemes.composition import Composition, stage_scheme
from vmri_jax.schemes.scheme import Scheme, fully_explicit, fully_implicit
from vmri_jax.steppers.solvers import Newton

AIMED_PART = 0.5
"""Part of the accuracy for which steps are chosen. Trials predict errors of finer runs to about a factor of 2: with a larger part more runs
miss the accuracy and are repeated, with a smaller part all runs take more steps."""
MOST_SAVED = 1000
"""Most saved intervals of a run with an accuracy whose user gives no number; a larger value takes more memory in long runs."""
FEWEST_STEPS = 16
"""Macro steps of the first trial of a scheme; a trial without a certified error is repeated with twice the steps. A larger value makes
searches with large accuracies slower."""
FIRST_MICRO = 5
"""Micro steps of the first trials; the search then chooses another number. One far from the best number makes the trials take longer."""
MOST_STEPS = 2**22
"""Macro steps of the longest trial. With a larger value searches for an accuracy out of reach take minutes."""
MOST_TRIAL_SECONDS = 20.0
"""Seconds of a trial, compiling included, after which the search stops to halve the steps of an uncertified trial. With a larger value
searches take longer where no error can be certified, as for chaotic motion."""
MOST_MICRO = 64
"""Most micro steps chosen; more save little unless an evaluation of the slow force takes a hundred times as long as of the fast force."""
MOST_COORDINATES = 60
"""Most coordinates of a system for which a single interval of high degree is tried, and for which resonances are looked up. The matrices of
both have a row for each coordinate: with 200 of them they take minutes, and schemes with kicks are faster."""
SAME_COST = 1.3
"""Ratio of two numbers of micro steps up to which they count as equally fast, so that the second is not compiled. A larger value misses
savings."""
LEAST_TIME = 0.02
"""Least seconds a and b in ``a + b N``, as a part of the seconds of a macro step, since the noise of the clock may make either of them zero.
A larger value pulls the number of micro steps towards the present one."""
LEAST_SHARE = 1e-3
"""Least slow share of the error, as a part of the fast share: the number of micro steps stays finite where the slow share vanishes. A larger
value allows fewer micro steps."""
SAMPLES = 4
"""Timed runs of each length, of which the fastest counts. With fewer runs other programs on the machine distort the prices of the steps."""
USUAL_TRIALS = 5
"""Trial runs of a usual search, the total that a progress bar starts with; with a larger value the bar ends before it is full."""
MOST_REPEATS = 5
"""Runs that may miss the accuracy before the search gives up; a larger value makes searches for an accuracy out of reach take longer."""
RESONANT_GROWTH = 1e-6
"""Growth of disturbances per macro step above which a step is resonant, see `vmri_jax.stability.advise`; a larger value accepts steps of
weak resonances."""
SHORTER_STEPS = (1.0, 0.98, 0.96, 0.93, 0.9, 0.86, 0.82, 0.78)
"""Macro steps that are tried in this order until one is not resonant, in units of the largest step for the accuracy."""


COMPOSED = ((2.5, None), (5.0, "suzuki4"), (8.0, "kahan-li6"), (np.inf, "kahan-li8"))
"""(most digits, composition): the composition for an accuracy of up to so many digits. Higher orders need fewer steps for many digits, and
more steps for few."""
ROUNDOFF = 100 * np.finfo(float).eps
"""Error below which an accuracy is refused as round-off, as a part of the largest position; a larger value refuses reachable accuracies."""


class AccuracyNotReached(UserWarning):
    """The error of a run exceeds its accuracy, or is not certified."""


@dataclass(frozen=True)
class Trial:
    """A run of a scheme and its error.

    Attributes:
        family, num_micro: the scheme.
        run: the simulation.
        trajectory: its trajectory.
        halved: trajectory of its companion with half the macro step.
        errors: (k, n_s + n_f) errors of the positions.
        error: the largest error; infinite unless all errors are certified.
    """

    family: Family
    num_micro: int
    run: Simulation
    trajectory: Trajectory
    halved: Trajectory
    errors: np.ndarray
    error: float

    @cached_property
    def seconds(self) -> float:
        """Measured seconds of a macro step."""
        return _seconds_of_steps(self.run)[0]

    def steps_for(self, error: float) -> int:
        """Macro steps for this error, ``n (e / error)^(1 / p)``."""
        return max(1, int(np.ceil(self.run.num_steps * (self.error / error) ** (1 / self.run.order))))

    def time_for(self, error: float) -> float:
        """Seconds of a run with this error; infinite if the error of the trial is not certified."""
        return self.steps_for(error) * self.seconds if np.isfinite(self.error) else np.inf


class Prices(NamedTuple):
    """Measured prices and errors of a scheme of order p, by which numbers of micro steps N are compared.

    macro_seconds, micro_seconds: a and b in the time ``a + b N`` of a macro step.
    slow, fast: the shares S and F of the error ``S + F / N^p`` of the trial's macro step.
    order: p.
    """

    macro_seconds: float
    micro_seconds: float
    slow: float
    fast: float
    order: int

    def relative_time(self, num_micro: int) -> float:
        """Time of a run with a given error, ``(a + b N) (S + F / N^p)^(1 / p)``, up to a factor that does not depend on N."""
        error = self.slow + self.fast / num_micro**self.order
        return (self.macro_seconds + num_micro * self.micro_seconds) * error ** (1 / self.order)


class Search:
    """Trial runs of several schemes from the same start over the same time.

    Args:
        make: function of a scheme that returns a `Simulation` of a single macro step.
        length: simulated time, in the unit of time of the system.
        num_saves: saved intervals; None for at most `MOST_SAVED`.
        progress: called before every trial run.
    """

    def __init__(
        self,
        make: Callable[[Scheme | Composition], Simulation],
        length: float,
        num_saves: int | None,
        progress: Progress = silent,
    ):
        self.make, self.length, self.num_saves, self.progress = make, length, num_saves, progress
        self.runs: dict[tuple[str, int], Simulation] = {}
        self.num_trials = 0
        self.prices: Prices | None = None

    def rounded(self, num_steps: int) -> tuple[int, int]:
        """(num_steps, save_every): the number of macro steps, rounded up to a multiple of the saved intervals."""
        saves = self.num_saves or min(num_steps, MOST_SAVED)
        save_every = -(-num_steps // saves)
        if self.num_saves is None:
            saves = -(-num_steps // save_every)
        return saves * save_every, save_every

    def run(self, family: Family, num_micro: int, num_steps: int) -> Simulation:
        """The run with at least `num_steps` macro steps."""
        key = family.python, num_micro
        if key not in self.runs:
            self.runs[key] = self.make(family.make(num_micro))
        num_steps, save_every = self.rounded(num_steps)
        dt = np.asarray(self.length / num_steps)
        return replace(self.runs[key], macro_dt=dt, num_steps=num_steps, save_every=save_every)

    def first_trials(self, menu: Sequence[tuple[Family, int]]) -> list[Trial]:
        """A trial of each scheme.

        First without the fallback: steps that are too large for the motion fail with any method. The fallback is compiled only if no scheme
        of the menu succeeds without it.
        """
        trials = [self.trial(*scheme, FEWEST_STEPS) for scheme in menu]
        if any(int(trial.trajectory.failed_at) < 0 for trial in trials):
            return trials
        return [self.trial(*scheme, FEWEST_STEPS, falls_back=True) for scheme in menu]

    def trial(self, family: Family, num_micro: int, num_steps: int, falls_back: bool = False) -> Trial:
        """The first trial with a certified error, of 1, 2, 4, ... times the macro steps; the last trial if the search runs out of time or steps.

        Args:
            family, num_micro: the scheme.
            num_steps: least number of macro steps.
            falls_back: whether exact matrices are tried where the first method fails, see `Simulation`.
        """
        while True:
            run = replace(self.run(family, num_micro, num_steps), may_fall_back=falls_back)
            total = max(USUAL_TRIALS, self.num_trials + 1)
            self.progress(f"trial of {family.label(num_micro)}, {run.num_steps} macro steps", self.num_trials, total)
            self.num_trials += 1
            before = time.perf_counter()
            trajectory, halved = run.in_pieces(), companion(run, run.scheme, 2)
            seconds = time.perf_counter() - before
            errors = extrapolated(run.order, trajectory, halved)
            done = max(int(trajectory.failed_at), int(halved.failed_at)) < 0
            certified = bool(done and certified_nodes(trajectory, errors)[0].all())
            # The seconds of the first trial include compiling, which later trials do not repeat.
            is_late = seconds > MOST_TRIAL_SECONDS and run.num_steps > FEWEST_STEPS
            is_last = 2 * run.num_steps > MOST_STEPS or is_late
            if certified or is_last:
                error = float(largest_of(errors).max()) if certified else np.inf
                return Trial(family, num_micro, run, trajectory, halved, errors, error)
            num_steps = 2 * run.num_steps

    def with_best_num_micro(self, trial: Trial, accuracy: float) -> Trial:
        """A trial with the number of micro steps of the least time for an accuracy; `trial` itself if its number is about as fast."""
        num_micro, p = trial.num_micro, trial.run.order
        finer = self.run(trial.family, 2 * num_micro, trial.run.num_steps)
        finer_trajectory = finer.in_pieces()
        if int(finer_trajectory.failed_at) >= 0:
            return trial
        fast_share = extrapolated(p, trial.trajectory, finer_trajectory)
        fast, slow = (float(largest_of(share).max()) for share in (fast_share, trial.errors - fast_share))
        # time(N) = a + b N: b = (time(2 N) - time(N)) / N and a = time(N) - N b
        seconds, finer_seconds = _seconds_of_steps(trial.run, finer)
        least = LEAST_TIME * seconds
        micro_seconds = max(finer_seconds - seconds, least) / num_micro
        macro_seconds = max(seconds - num_micro * micro_seconds, least)
        slow = max(slow, LEAST_SHARE * fast)
        self.prices = Prices(macro_seconds, micro_seconds, slow, num_micro**p * fast, p)
        # N^(p + 1) = (a / b) (F / S), rounded to a multiple of the unit of the rules
        best = (macro_seconds / micro_seconds * self.prices.fast / slow) ** (1 / (p + 1))
        unit = _unit(trial.run.system, stage_scheme(trial.run.scheme))
        best = unit * int(np.clip(round(best / unit), 1, max(1, MOST_MICRO // unit)))
        if max(best, num_micro) <= SAME_COST * min(best, num_micro):
            return trial
        num_steps = max(1, round(trial.run.num_steps * num_micro / best))  # micro steps of about the same length
        new_trial = self.trial(trial.family, best, num_steps, trial.run.may_fall_back)
        return min((trial, new_trial), key=lambda candidate: candidate.time_for(AIMED_PART * accuracy))


def with_accuracy(
    system: Movable,
    scheme: Scheme | Composition | None,
    state: State | None,
    solver: Newton | None,
    accuracy: float,
    *,
    t_end: float,
    num_saves: int | None,
    of: Callable | None = None,
    progress: Progress = silent,
) -> tuple[Trial, Settings]:
    """The trial whose largest estimated error of a position is at most `accuracy`, and its settings.

    Warns with `AccuracyNotReached` if no trial is as accurate.

    Args:
        system, scheme, state, solver, t_end: as of `vmri_jax.simulate`; scheme None for a scheme from the menu.
        accuracy: largest error, in the unit of the positions.
        num_saves: saved intervals, equally spaced; None for at most `MOST_SAVED`.
        of: function of a run, refused before the trials if it returns no numbers.
        progress: called before every trial run.

    Raises:
        TypeError: scheme is not a scheme.
        ValueError: an accuracy below round-off, or above the extent of the motion; arguments that `vmri_jax.simulate` refuses.
    """
    if not isinstance(scheme, Scheme | Composition | None):
        raise TypeError(
            f"simulate: scheme is {type(scheme).__name__}; give a Scheme, e.g. fully_implicit(num_micro=10), or None."
        )
    opened_system, start = start_of("simulate", system, state)
    if not is_concrete((vars(start), opened_system.params, t_end)):
        raise ValueError(
            "simulate: an accuracy compares runs with numbers; call simulate outside of jax.jit, vmap and grad."
        )
    length = float(t_end - start.t)
    _check(accuracy, length, start)

    def make(scheme: Scheme | Composition) -> Simulation:
        run = simulation(system, scheme, state, solver, Steps(length, num_steps=1))
        run.check()
        check_memory("simulate", run.state, scheme.num_micro, num_saves or MOST_SAVED, False)
        check_function_of_run(of, True, run)
        return run

    search = Search(make, length, num_saves, progress)
    menu = _menu(scheme, opened_system, start, accuracy, length)
    trials = search.first_trials(menu)
    extent = max(extent_of(trial.trajectory) for trial in trials)
    if accuracy > extent:
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
    if not best.error <= accuracy:
        reached = (
            f"its error is {best.error:.1e}" if np.isfinite(best.error) else "no error is certified over its length"
        )
        warnings.warn(
            f"simulate: accuracy {accuracy:g} is not reached with {best.run.num_steps} macro steps, {reached}; give a shorter t_end, a "
            "larger accuracy, or another scheme.",
            AccuracyNotReached,
            stacklevel=3,
        )
    numbers = float(best.run.macro_dt), best.run.num_steps, best.run.save_every
    python = best.family.python.format(best.num_micro)
    gain, prices = 1.0, search.prices
    if prices is not None and best.num_micro > 1:
        gain = prices.relative_time(1) / prices.relative_time(best.num_micro)
    return best, Settings(best.run.scheme, python, best.family.options, *numbers, gain)


def _accurate(search: Search, best: Trial, accuracy: float) -> Trial:
    """A trial of the scheme of `best` with an error of at most `accuracy`, or the last trial if `MOST_REPEATS` of them miss it."""
    fewest = 1
    for _ in range(MOST_REPEATS):
        if not np.isfinite(best.error):
            break
        num_steps = _beside_resonances(search, best, max(best.steps_for(AIMED_PART * accuracy), fewest))
        if num_steps > MOST_STEPS:
            break
        best = search.trial(best.family, best.num_micro, num_steps, best.run.may_fall_back)
        if best.error <= accuracy:
            break
        fewest = best.run.num_steps + 1
    return best


def _check(accuracy: float, length: float, start: State) -> None:
    """Refuse accuracies below round-off, and an end before the start."""
    check_number("simulate: accuracy", accuracy)
    size = max(np.abs(np.asarray(q)).max(initial=0.0) for q in (start.q_s, start.q_f))
    floor = ROUNDOFF * size
    if not (np.isfinite(accuracy) and accuracy > floor):
        raise ValueError(
            f"simulate: accuracy is {accuracy:g}; round-off of float64 alone is about {floor:.0e}, since the largest position is {size:.3g}. "
            "Give a larger one, in the unit of the positions."
        )
    if not length > 0:
        raise ValueError(f"simulate: t_end is {length:g} after the start; it must be later.")


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
    unit = _unit(system, stage_scheme(base.make(1)))
    num_micro = unit * -(-FIRST_MICRO // unit) if micro_steps_help(system, start) else 1
    kicks = base if name is None else base.composed(name), num_micro
    single = of_degree(int(np.clip(np.ceil(digits), 2, 8))), 1
    # A single micro interval cannot carry a rule on every k-th micro node.
    has_single = unit == 1 and start.q_s.size + start.q_f.size <= MOST_COORDINATES
    return [kicks, single] if has_single else [kicks]


def micro_steps_help(system: System, start: State) -> bool:
    """Whether micro steps may save time: the system has fast coordinates, and slow coordinates or potentials for the macro grid."""
    return bool(start.q_f.size and (start.q_s.size or system.slow_potential is not None or system.potentials))


def _unit(system: System, scheme: Scheme) -> int:
    """The number whose multiples are allowed as num_micro: the least common multiple of all k of rules on every k-th micro node."""
    return math.lcm(scheme.unit, *(name for name, _ in system.potentials if isinstance(name, int)))


def _seconds_of_steps(*runs: Simulation) -> np.ndarray:
    """Seconds of a macro step of each run, ``(T(2 n) - T(n)) / n``: the difference cancels the fixed cost of a call."""
    doubles = [replace(run, num_steps=2 * run.num_steps, save_every=2 * run.save_every) for run in runs]
    seconds = least_seconds([run.in_pieces for run in (*runs, *doubles)], SAMPLES)
    single, double = np.reshape(seconds, (2, len(runs)))
    return np.maximum(double - single, 0.1 * double) / [
        run.num_steps for run in runs
    ]  # noise may make the difference negative


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

"""Steps for an accuracy: H and num_micro of a scheme, and the scheme from a small menu, by the errors of trial runs.

A trial is a run over the whole time with large macro steps, and one with half of them; their difference is its error e, see
`vmri_jax.accuracy.companions`. A scheme of order p keeps the error ``eps`` in

    n = n_trial (e / eps)^(1 / p)

macro steps. With the slow share ``S H^p`` and the fast share ``F (H/N)^p`` of e, and a time of ``a + b N`` for a macro step of N micro
steps, the least time for an error is reached with

    N^(p + 1) = (a / b) (F / S),

where the time that is spent on each grid goes with the share that it leaves.
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

AIM = 0.5
"""Part of the accuracy that steps are chosen for. Trials predict errors of finer runs to about a factor of 2; with a larger part more runs
miss the accuracy and are made again, with a smaller one all take more steps."""
SAVED = 1000
"""Most saved intervals of a run whose number of steps is chosen; more make long runs fill the memory."""
FEWEST_STEPS, FIRST_MICRO = 16, 5
"""Macro steps and micro steps of first trials; trials that do not see the motion are made again with twice the steps."""
MOST_STEPS = 2**22
"""Macro steps of the longest run that is tried. A larger number lets searches for what cannot be reached take minutes."""
LONGEST = 20.0
"""Seconds of a run and its companion, compiling included, after which steps are not halved further. A larger value makes a search for
an error that cannot be certified, as of chaotic motion, take longer."""
MOST_MICRO = 64
"""Most micro steps that are chosen; more save little where slow forces are not a hundred times as dear as fast ones."""
MOST_COORDINATES = 60
"""Coordinates of the largest system that a single interval of high degree is tried on, and whose steps are looked at for resonances. The
matrices of both have all coordinates: with 200 of them they take minutes, and steps by kicks win."""
SAME = 1.3
"""Factor within which two numbers of micro steps cost the same: the second is not compiled. A larger one misses savings."""
LEAST_TIME, LEAST_SHARE = 0.02, 1e-3
"""Least time of a grid over that of a macro step, and least slow share over the fast one: numbers of micro steps stay finite where a measured
time or a share vanishes."""
SAMPLES = 4
"""Runs whose least time counts; with fewer of them what runs between makes micro steps look dear or cheap by chance."""
USUAL_TRIALS = 5
"""Trial runs of a usual search, which a bar of progress starts from; with another number the bar moves too fast or too slowly."""
REPEATS = 5
"""Runs after the first one that may miss the accuracy before the search gives up."""
RESONANT = 1e-6
"""Growth of disturbances in a macro step above which a step is resonant, see `vmri_jax.stability.advise`."""
SHORTER = (1.0, 0.98, 0.96, 0.93, 0.9, 0.86, 0.82, 0.78)
"""Macro steps that are looked at for one without resonance, in units of the one that accuracy asks for."""


COMPOSED = ((2.5, None), (5.0, "suzuki4"), (8.0, "kahan-li6"), (np.inf, "kahan-li8"))
"""Compositions by the digits of accuracy up to which they are taken: higher orders need fewer steps for many digits, and more for few."""
ROUNDOFF = 100 * np.finfo(float).eps
"""Part of the largest position below which errors are round-off."""


class AccuracyNotReached(UserWarning):
    """A run has a larger error than it was asked for, or one that is not certified."""


@dataclass(frozen=True)
class Trial:
    """A run of a scheme and its error.

    Attributes:
        family, num_micro: the scheme.
        run: the simulation.
        trajectory, halved: its result, and that with half the macro step.
        errors: (k, n_s + n_f) of the positions.
        error: the largest of them; infinite where one is not certified.
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
        """Time of a macro step."""
        return _seconds_of_steps(self.run)[0]

    def steps_for(self, error: float) -> int:
        """Macro steps that keep this error, by the order of the scheme."""
        return max(1, int(np.ceil(self.run.num_steps * (self.error / error) ** (1 / self.run.order))))

    def time_for(self, error: float) -> float:
        """Seconds of a run that keeps this error; infinite where none is certified."""
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
        """Time of a run with a certain error, ``(a + b N) (S + F / N^p)^(1 / p)``, up to a factor that does not depend on N."""
        error = self.slow + self.fast / num_micro**self.order
        return (self.macro_seconds + num_micro * self.micro_seconds) * error ** (1 / self.order)


class Search:
    """Trial runs from one start over one length of time.

    Args:
        make: a `Simulation` of a scheme, of a single macro step.
        length: time that is simulated, s.
        num_saves: saved intervals; None for at most `SAVED`.
        progress: told before every trial run.
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

    def saving(self, num_steps: int) -> tuple[int, int]:
        """At least so many macro steps, a multiple of the saved intervals, and the macro steps from one saved node to the next."""
        saves = self.num_saves or min(num_steps, SAVED)
        save_every = -(-num_steps // saves)
        if self.num_saves is None:
            saves = -(-num_steps // save_every)
        return saves * save_every, save_every

    def run(self, family: Family, num_micro: int, num_steps: int) -> Simulation:
        """The run with at least so many macro steps."""
        key = family.python, num_micro
        if key not in self.runs:
            self.runs[key] = self.make(family.make(num_micro))
        num_steps, save_every = self.saving(num_steps)
        dt = np.asarray(self.length / num_steps)
        return replace(self.runs[key], macro_dt=dt, num_steps=num_steps, save_every=save_every)

    def first_trials(self, menu: Sequence[tuple[Family, int]]) -> list[Trial]:
        """A trial of each scheme.

        Steps that are too large for the motion fail or diverge, and need no fallback: it is compiled only where no scheme of the menu works
        without it.
        """
        trials = [self.trial(*scheme, FEWEST_STEPS) for scheme in menu]
        if any(int(trial.trajectory.failed_at) < 0 for trial in trials):
            return trials
        return [self.trial(*scheme, FEWEST_STEPS, falls_back=True) for scheme in menu]

    def trial(self, family: Family, num_micro: int, num_steps: int, falls_back: bool = False) -> Trial:
        """The first trial with a certified error, of 1, 2, 4, ... times the macro steps; else the last one in the time there is.

        Args:
            family, num_micro: the scheme.
            num_steps: macro steps, at least.
            falls_back: whether steps that the first method does not solve are made again with exact matrices, see `Simulation`.
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
            is_last = 2 * run.num_steps > MOST_STEPS or (seconds > LONGEST and run.num_steps > FEWEST_STEPS)
            if certified or is_last:
                error = float(largest_of(errors).max()) if certified else np.inf
                return Trial(family, num_micro, run, trajectory, halved, errors, error)
            num_steps = 2 * run.num_steps

    def with_best_num_micro(self, trial: Trial, accuracy: float) -> Trial:
        """A trial with the number of micro steps of the least time for an accuracy, if that differs."""
        num_micro, p = trial.num_micro, trial.run.order
        finer = self.run(trial.family, 2 * num_micro, trial.run.num_steps)
        finer_trajectory = finer.in_pieces()
        if int(finer_trajectory.failed_at) >= 0:
            return trial
        by_fast = extrapolated(p, trial.trajectory, finer_trajectory)
        fast, slow = (float(largest_of(part).max()) for part in (by_fast, trial.errors - by_fast))
        of_one, of_two = _seconds_of_steps(trial.run, finer)
        # b = (time(2 N) - time(N)) / N and a = time(N) - N b; noise of the clock must not make one of them zero
        least = LEAST_TIME * of_one
        micro_seconds = max(of_two - of_one, least) / num_micro
        macro_seconds = max(of_one - num_micro * micro_seconds, least)
        slow = max(slow, LEAST_SHARE * fast)
        self.prices = Prices(macro_seconds, micro_seconds, slow, num_micro**p * fast, p)
        best = (macro_seconds / micro_seconds * self.prices.fast / slow) ** (1 / (p + 1))
        unit = _unit(trial.run.system, stage_scheme(trial.run.scheme))
        best = unit * int(np.clip(round(best / unit), 1, max(1, MOST_MICRO // unit)))
        if max(best, num_micro) <= SAME * min(best, num_micro):
            return trial
        num_steps = max(1, round(trial.run.num_steps * num_micro / best))
        other = self.trial(trial.family, best, num_steps, trial.run.may_fall_back)
        return min((trial, other), key=lambda one: one.time_for(AIM * accuracy))


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
        system, scheme, state, solver, t_end: as of `vmri_jax.simulate`; None for a scheme from the menu.
        accuracy: in the unit of the positions.
        num_saves: saved intervals, equally spaced; None for at most `SAVED`.
        of: function of a run, refused before the trials if it returns no numbers.
        progress: told before every trial run.

    Raises:
        TypeError: not a scheme.
        ValueError: an accuracy below round-off, or above the extent of the motion; what `vmri_jax.simulate` refuses.
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
        check_memory("simulate", run.state, scheme.num_micro, num_saves or SAVED, False)
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
    best = min(trials, key=lambda trial: trial.time_for(AIM * accuracy))
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
    """A trial of the same scheme with an error below `accuracy`, made again with more steps where it misses; else the last one."""
    fewest = 1
    for _ in range(REPEATS):
        if not np.isfinite(best.error):
            break
        num_steps = _beside_resonances(search, best, max(best.steps_for(AIM * accuracy), fewest))
        if num_steps > MOST_STEPS:
            break
        best = search.trial(best.family, best.num_micro, num_steps, best.run.may_fall_back)
        if best.error <= accuracy:
            break
        fewest = best.run.num_steps + 1
    return best


def _check(accuracy: float, length: float, start: State) -> None:
    """Refuse accuracies that no run can have."""
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
    """Families and their first numbers of micro steps.

    A scheme of the user's is the only one. Else there are two: kicks, for masses that depend on the configuration the midpoint rule, composed
    to an order of about the number of digits that are asked for; and a single interval of high degree.
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
    # A single interval has no k-th micro node.
    has_single = unit == 1 and start.q_s.size + start.q_f.size <= MOST_COORDINATES
    return [kicks, single] if has_single else [kicks]


def micro_steps_help(system: System, start: State) -> bool:
    """Whether a macro step may save something: fast coordinates, and slow ones or potentials that the macro grid evaluates less often."""
    return bool(start.q_f.size and (start.q_s.size or system.slow_potential is not None or system.potentials))


def _unit(system: System, scheme: Scheme) -> int:
    """The smallest number of micro steps that all rules on every k-th micro node fit into."""
    return math.lcm(scheme.unit, *(name for name, _ in system.potentials if isinstance(name, int)))


def _seconds_of_steps(*runs: Simulation) -> np.ndarray:
    """Seconds of a macro step of each run: the difference of runs of n and of 2 n steps, without what a call takes besides."""
    doubles = [replace(run, num_steps=2 * run.num_steps, save_every=2 * run.save_every) for run in runs]
    seconds = least_seconds([each.in_pieces for each in (*runs, *doubles)], SAMPLES)
    once, twice = np.reshape(seconds, (2, len(runs)))
    return np.maximum(twice - once, 0.1 * twice) / [run.num_steps for run in runs]


def _beside_resonances(search: Search, trial: Trial, num_steps: int) -> int:
    """This number of macro steps, or the next larger one at which small motions about the start do not grow."""
    from vmri_jax.stability.linear import (
        small_motions,  # only here: that room draws, and matplotlib takes half a second
    )
    from vmri_jax.stability.multipliers import multipliers

    start = trial.run.state
    if trial.num_micro == 1 or start.q_s.size + start.q_f.size > MOST_COORDINATES:
        return num_steps
    try:
        motions = small_motions(trial.run.system, trial.run.state)
    except ValueError:  # a start without small motions, as of a mechanism that is driven in all of its freedoms
        return num_steps
    numbers = [search.saving(int(np.ceil(num_steps / shorter)))[0] for shorter in SHORTER]
    radii = multipliers(motions, trial.run.scheme, [search.length / n for n in numbers]).radius
    return next((n for n, radius in zip(numbers, radii, strict=True) if radius <= 1 + RESONANT), num_steps)

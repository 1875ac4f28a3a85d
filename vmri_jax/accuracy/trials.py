"""Trial runs of schemes over the whole time, their errors, and the number of micro steps of the least time."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from vmri_jax.accuracy.companions import (
    FEWEST_DIVIDED,
    certified_nodes,
    companion,
    estimated_errors,
    extrapolated,
    fewest_steps,
)
from vmri_jax.accuracy.families import Family
from vmri_jax.mechanics.driving import Events
from vmri_jax.mechanics.system import System
from vmri_jax.running.progress import Progress, silent
from vmri_jax.running.run_error import largest_of
from vmri_jax.running.simulation import Simulation
from vmri_jax.running.timing import least_seconds
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.schemes.composition import Composition, stage_scheme
from vmri_jax.schemes.scheme import Scheme

AIMED_PART = 0.5
"""Part of the accuracy for which steps are chosen. Trials predict errors of finer runs to about a factor of 2: with a larger part more runs
miss the accuracy and are repeated, with a smaller part all runs take more steps."""
MOST_SAVED = 1000
"""Most saved intervals of a run with an accuracy whose user gives no number; a larger value takes more memory in long runs."""
MOST_STEPS = 2**22
"""Macro steps of the longest trial. With a larger value searches for an accuracy out of reach take minutes."""
MOST_TRIAL_SECONDS = 20.0
"""Seconds of a trial, compiling included, after which the search no longer halves the steps of an uncertified trial. With a larger value
searches take longer where no error can be certified, as for chaotic motion."""
MOST_MICRO = 64
"""Most micro steps chosen; more save little unless an evaluation of the slow force takes a hundred times as long as of the fast force."""
SAME_COST = 1.3
"""Ratio of two numbers of micro steps up to which they count as equally fast, so that the second is not compiled. A larger value misses
savings."""
LEAST_TIME = 0.02
"""Least seconds a and b N in ``a + b N``, as a part of the seconds of a macro step, since the noise of the clock may make either of them zero.
A larger value pulls the number of micro steps towards the present one."""
LEAST_SHARE = 1e-3
"""Least slow share of the error, as a part of the fast share: the number of micro steps stays finite where the slow share vanishes. A larger
value allows fewer micro steps."""
SAMPLES = 4
"""Timed runs of each length, of which the fastest counts. With fewer runs other programs on the machine distort the prices of the steps."""
USUAL_TRIALS = 5
"""Trial runs of a usual search, the total that a progress bar starts with; with a larger value the bar ends before it is full."""
FEWEST_STEPS = 16
"""Macro steps of the first trial of a scheme; a trial without a certified error is repeated with twice the steps. A larger value makes
searches with large accuracies slower."""


@dataclass(frozen=True)
class Trial:
    """A run of a scheme, its companion with half the macro step, and its errors.

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

    def steps_for(self, error: float, order: float | None = None) -> int:
        """Macro steps for this error, ``n (e / error)^(1 / p)``, with the order of the scheme if None is given."""
        return max(1, int(np.ceil(self.run.num_steps * (self.error / error) ** (1 / (order or self.run.order)))))

    def time_for(self, error: float) -> float:
        """Seconds of a run with this error; infinite if the error of the trial is not certified."""
        return self.steps_for(error) * self.seconds if np.isfinite(self.error) else np.inf


@dataclass
class Search:
    """Trial runs of several schemes from the same start over the same time, the `length`.

    make: function of a scheme that returns a `Simulation` of a single macro step.
    num_saves: saved intervals; None for at most `MOST_SAVED`.
    drives: events of the system in this time; all runs have steps that see them.
    """

    make: Callable[[Scheme | Composition], Simulation]
    length: float
    num_saves: int | None
    progress: Progress = silent
    drives: Events = Events()  # noqa: RUF009 (immutable)
    runs: dict[tuple[str, int], Simulation] = field(default_factory=dict)
    num_trials: int = 0
    relative_time: Callable[[int], float] | None = None

    def rounded(self, num_steps: int) -> tuple[int, int]:
        """(num_steps, save_every): the number of macro steps, rounded up to a multiple of the saved intervals."""
        saves = self.num_saves or min(num_steps, MOST_SAVED)
        save_every = -(-num_steps // saves)
        if self.num_saves is None:
            saves = -(-num_steps // save_every)
            saves = -(-saves // FEWEST_DIVIDED) * FEWEST_DIVIDED if self.drives.names else saves
        return saves * save_every, save_every

    def run(self, family: Family, num_micro: int, num_steps: int) -> Simulation:
        """The run with at least `num_steps` macro steps, and with steps that see all events."""
        key = family.python, num_micro
        if key not in self.runs:
            self.runs[key] = self.make(family.make(num_micro))
        fewest = fewest_steps(self.runs[key].scheme, self.drives, self.length)
        num_steps, save_every = self.rounded(max(num_steps, fewest))
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

    def trial(
        self, family: Family, num_micro: int, num_steps: int, falls_back: bool = False, accuracy: float | None = None
    ) -> Trial:
        """The first trial with a certified error, of 1, 2, 4, ... times the macro steps; the last trial if the search runs out of time or steps.

        `falls_back` tells whether the fallback is tried where the first solver fails, see `Simulation`. With an accuracy the errors are also from
        a third companion where it is needed, see `estimated_errors`.
        """
        while True:
            run = replace(self.run(family, num_micro, num_steps), may_fall_back=falls_back)
            total = max(USUAL_TRIALS, self.num_trials + 1)
            self.progress(f"trial of {family.label(num_micro)}, {run.num_steps} macro steps", self.num_trials, total)
            self.num_trials += 1
            before = time.perf_counter()
            trajectory, halved = run.in_pieces(), companion(run, 2)
            seconds = time.perf_counter() - before
            done = max(int(trajectory.failed_at), int(halved.failed_at)) < 0
            if done and accuracy is not None:
                errors = estimated_errors(run, trajectory, halved, self.drives, accuracy)
            else:
                errors = extrapolated(run.order, trajectory, halved)
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
        fast = num_micro**p * fast

        def relative_time(num_micro: int) -> float:
            """Time of a run with a given error, ``(a + b N) (S + F / N^p)^(1 / p)``, up to a factor that does not depend on N."""
            return (macro_seconds + num_micro * micro_seconds) * (slow + fast / num_micro**p) ** (1 / p)

        self.relative_time = relative_time
        # N^(p + 1) = (a / b) (F / S), rounded to a multiple of the unit of the rules
        best = (macro_seconds / micro_seconds * fast / slow) ** (1 / (p + 1))
        unit = unit_of(trial.run.system, stage_scheme(trial.run.scheme))
        best = unit * int(np.clip(round(best / unit), 1, max(1, MOST_MICRO // unit)))
        if max(best, num_micro) <= SAME_COST * min(best, num_micro):
            return trial
        num_steps = max(1, round(trial.run.num_steps * num_micro / best))  # micro steps of about the same length
        new_trial = self.trial(trial.family, best, num_steps, trial.run.may_fall_back)
        return min((trial, new_trial), key=lambda candidate: candidate.time_for(AIMED_PART * accuracy))


def unit_of(system: System, scheme: Scheme) -> int:
    """The number whose multiples are allowed as num_micro: the least common multiple of all k of rules on every k-th micro node."""
    return math.lcm(scheme.unit, *(name for name, _ in system.potentials if isinstance(name, int)))


def _seconds_of_steps(*runs: Simulation) -> np.ndarray:
    """Seconds of a macro step of each run, ``(T(2 n) - T(n)) / n``: the difference cancels the fixed cost of a call."""
    doubles = [replace(run, num_steps=2 * run.num_steps, save_every=2 * run.save_every) for run in runs]
    seconds = least_seconds([run.in_pieces for run in (*runs, *doubles)], SAMPLES)
    single, double = np.reshape(seconds, (2, len(runs)))
    num_steps = [run.num_steps for run in runs]
    return np.maximum(double - single, 0.1 * double) / num_steps  # noise may make the difference negative

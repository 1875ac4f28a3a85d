"""The search for the scheme and the steps of the least time for an accuracy, from the errors and times of trial runs.

A trial is a run over the whole time, and a companion run with half the macro step; both give the error e of the trial,
see `vmri_jax.accuracy.companions`. A scheme of order p has an error of at most ``eps`` with

    n = n_trial (e / eps)^(1 / p)

macro steps. A macro step of N micro steps takes the time ``a + b N`` and makes an error with the shares ``S H^p``
(slow) and ``F (H/N)^p`` (fast). The least time for a given error is reached with

    N^(p + 1) = (a / b) (F / S).

Then the times on both grids have the ratio of the error shares, ``a / (b N) = S / (F / N^p)``.

`Search.cheapest` has three stages: a trial of each family of a menu with large steps; the number of micro steps of the
families that promise the least time; their steps for the accuracy. `vmri_jax.simulate` with an accuracy takes the first
of two families, `vmri_jax.tune` compares the best of many.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property, partial

import numpy as np

from vmri_jax.accuracy.companions import (
    FEWEST_DIVIDED,
    MOST_STEPS,
    Trial,
    check_function_of_run,
    companion,
    extent_of,
    fewest_steps,
)
from vmri_jax.accuracy.families import LEAST_TIME, Family, seconds_of_steps, unit_of
from vmri_jax.mechanics.checks import check_number
from vmri_jax.mechanics.driving import Events, events
from vmri_jax.mechanics.invariants import velocity
from vmri_jax.mechanics.linearisation import Linearisation, linearise
from vmri_jax.mechanics.state import Movable, State, start_of
from vmri_jax.refusals import Refused, warn_user
from vmri_jax.running.arguments import refuse_tracers
from vmri_jax.running.origin import Settings
from vmri_jax.running.progress import Progress, silent
from vmri_jax.running.run_error import largest_of
from vmri_jax.running.saved import check_memory
from vmri_jax.running.simulation import Simulation, simulation
from vmri_jax.running.timing import stopwatch
from vmri_jax.schemes.composition import SchemeLike, stage_lengths, stage_scheme
from vmri_jax.steppers.solver import Solver

AIMED_PART = 0.5
"""Part of the accuracy for which steps are chosen. Trials predict errors of finer runs to about a factor of 2: with a
larger part more runs miss the accuracy and are repeated, with a smaller part all runs take more steps."""
ROUNDOFF = 100 * np.finfo(float).eps
"""Error refused as round-off, as a part of the largest position; a larger value refuses reachable accuracies."""
MOST_SAVED = 1000
"""Most saved intervals of a run with an accuracy if the user gives no number; a larger value takes more memory."""
MANY_STEPS = 100_000
"""Macro steps that short events demand, above which a warning tells of them; a smaller value warns of fast runs."""
FEWEST_STEPS = 16
"""Macro steps of the first trial of a scheme; a trial without a certified error is repeated with twice the steps. A
larger value makes searches with large accuracies slower."""
MOST_GROWTH = 64
"""Most steps of a run over the steps of the run before. With a larger number a search whose accuracy is out of reach,
as with jumps of forces, ends with fewer steps than it could take; with a smaller one it repeats runs more often."""
MOST_REPEATS = 5
"""Runs that may miss the accuracy before a search ends; a larger value takes longer where it is out of reach."""
MOST_TRIAL_SECONDS = 20.0
"""Seconds of a trial, compiling included, after which the search no longer halves the steps of an uncertified trial.
With a larger value searches take longer where no error can be certified, as for chaotic motion."""
LEAST_TRIAL_SECONDS = 0.5
"""Seconds of an uncertified trial that a family may take in any case; with a smaller value the cost of a call decides
which families are given up."""
MOST_TIME_RATIO = 5.0
"""A family is given up when its trials, still uncertified, take this many times as long as the best family so far would
take for the accuracy, and where its run promises to take this many times as long. A larger ratio searches longer."""
NUM_MICRO = (1, 2, 3, 5, 8, 12, 20, 30, 50)
"""Numbers of micro steps that an exhaustive search tries, in units of the rates of the potentials."""
MOST_MICRO = 64
"""Most micro steps chosen; more save little unless the slow force takes a hundred times as long as the fast one."""
WORTH_COMPILING = 1.5
"""Time of a run over the time that a third number of micro steps promises, above which its program is compiled. A
larger value misses savings; a smaller one compiles for seconds to save milliseconds."""
LEAST_SHARE = 1e-3
"""Least slow share of the error, as a part of the fast share: the number of micro steps stays finite where the slow
share vanishes. A larger value allows fewer micro steps."""
USUAL_TRIALS = 5
"""Trial runs of a usual search, the total that a bar starts with; with a larger value the bar ends early."""
MOST_COORDINATES = 60
"""Most coordinates of a system for which a single interval of high degree is tried, and for which resonances are looked
up. The matrices of both have a row for each coordinate: with 200 of them they take minutes, and schemes with kicks are
faster."""
RESONANT_GROWTH = 1e-6
"""Growth of disturbances per macro step above which a step is resonant, see `vmri_jax.stability.advise`; a larger value
accepts steps of weak resonances."""
LEAST_RESONANT_ANGLE = 2.5
"""Angle in radians that the fastest vibration turns in a macro step, below which no step is resonant: multipliers of
opposite signature meet at an angle of pi at the earliest, which kicks with two micro steps have at 2.8. A larger value
overlooks the first resonance; a smaller one compiles the step of the linear system for nothing."""
SHORTER_STEPS = (1.0, 0.98, 0.96, 0.93, 0.9, 0.86, 0.82, 0.78)
"""Macro steps that are tried in this order until one is not resonant, in units of the largest step for the accuracy."""


class Search:
    """Trial runs of several schemes from the same start until `t_end`; arguments as of `vmri_jax.simulate`.

    name: of the accuracy, which begins messages.
    system, start, t_end, length: of all runs.
    falls_back: whether trials may take the fallback.
    seconds: measured seconds of a macro step by the Python expression of the scheme.
    """

    def __init__(
        self,
        moving: Movable,
        t_end: float,
        *,
        state: State | None = None,
        solver: Solver | None = None,
        num_saves: int | None = None,
        of: Callable | None = None,
        progress: Progress = silent,
        name: str = "simulate: accuracy",
    ):
        self.system, self.start = start_of("simulate", moving, state)
        refuse_tracers("simulate: an accuracy", (self.start, self.system.params, t_end))
        self.name, self.t_end, self.length = name, float(t_end), float(t_end - self.start.t)
        if not 0 < self.length < np.inf:
            raise Refused(f"t_end is {self.length:g} after the start; it must be later, by a finite time.")
        self.num_saves, self.progress, self.num_trials, self.falls_back = num_saves, progress, 0, False
        self.seconds: dict[str, float] = {}
        self._arguments, self._of = (moving, state, solver), of
        self._runs: dict[str, Simulation] = {}
        self._firsts: dict[str, Trial] = {}
        self._chosen: dict[str, Trial] = {}
        self._times: dict[str, Callable[[int], float]] = {}

    @cached_property
    def drives(self) -> Events:
        """The events of the system in this time; all runs have steps that see them."""
        return events(self.system, self.start, self.t_end)

    @cached_property
    def has_two_rates(self) -> bool:
        """Whether micro steps may save time: there are fast coordinates, and slow ones or potentials for the macro
        grid."""
        has_slow = self.start.q_s.size or self.system.slow_potential is not None or self.system.potentials
        return bool(self.start.q_f.size and has_slow)

    @property
    def round_off(self) -> float:
        """The error of positions that round-off alone causes."""
        return ROUNDOFF * max(float(np.abs(np.asarray(q)).max(initial=0.0)) for q in (self.start.q_s, self.start.q_f))

    def check(self, accuracy: float) -> None:
        """Refuse accuracies that round-off hides."""
        check_number(self.name, accuracy)
        if not accuracy > self.round_off:
            size = f"the largest position is {self.round_off / ROUNDOFF:.3g}"
            reason = f"{size}, so that round-off of float64 alone is about {self.round_off:.0e}"
            raise Refused(f"{self.name} is {accuracy:g}; {reason}. Give a larger one, in the unit of the positions.")

    def check_extent(self, accuracy: float) -> None:
        """Refuse an accuracy above the extent of the motion in the first trials."""
        extent = self.extent()
        # Driven systems: positions at few saved nodes may hide the motion, and all trials see the events.
        if accuracy > extent and not self.drives.names:
            moves = f"no position moves by more than {extent:.3g} until t = {self.t_end:g}: any run is as accurate"
            raise Refused(f"{self.name} is {accuracy:g}, and {moves}; give a smaller one.")

    def digits(self, accuracy: float) -> float:
        """The digits of an accuracy, at least one, relative to the largest position, or largest speed times length."""
        q, v = (self.start.q_s, self.start.q_f), velocity(self.system, *list(vars(self.start).values())[1:])
        size, speed = (max(np.abs(np.asarray(a)).max(initial=0.0) for a in pair) for pair in (q, v))
        return float(np.log10(max((size or speed * self.length) / accuracy, 10.0)))

    def cheapest(
        self, menu: Sequence[Family], accuracy: float, finalists: int = 1, exhaustive: bool = False
    ) -> list[Trial]:
        """Trials with steps for the accuracy, of the families that promise the least time, the most promising one
        first; exhaustive ones of all families with all of `NUM_MICRO`. Refuses an accuracy that any run keeps."""
        if exhaustive:
            units = [(family, unit_of(self.system, family.scheme)) for family in menu]
            menu = [replace(family, first=unit * n) for family, unit in units for n in NUM_MICRO]
            finalists = len(menu)
        aimed, trials = AIMED_PART * accuracy, self.first_trials(menu, accuracy)
        self.check_extent(accuracy)
        trials = sorted(trials, key=lambda trial: self.time_for(trial, aimed))
        most = MOST_TIME_RATIO * self.time_for(trials[0], aimed)
        promising = [trial for trial in trials[:finalists] if self.time_for(trial, aimed) <= most]
        chosen = promising if exhaustive else [self._with_best_num_micro(trial, aimed) for trial in promising]
        return [self.accurate(trial, accuracy) for trial in chosen]

    def first_trials(self, menu: Sequence[Family], accuracy: float) -> list[Trial]:
        """A trial of each family whose steps can see all events, refused if there is none. The search makes each trial
        once: without the fallback, since steps that are too large for the motion fail with any method, and with it only
        if no scheme of the menu succeeds without it."""
        seeing = []
        for family in menu:
            with suppress(Refused):
                fewest_steps(family.scheme, self.drives, self.length)
                seeing.append(family)
        limit, trials, menu = np.inf, [], seeing or menu
        for family in menu:
            if family.expression not in self._firsts:
                most_seconds = max(limit, LEAST_TRIAL_SECONDS)
                self._firsts[family.expression] = self.trial(family, FEWEST_STEPS, most_seconds=most_seconds)
            trials.append(self._firsts[family.expression])
            if len(menu) > 1:
                limit = min(limit, MOST_TIME_RATIO * self.time_for(trials[-1], AIMED_PART * accuracy))
        if self.falls_back or any(int(trial.trajectory.failed_at) < 0 for trial in trials):
            return trials
        self.falls_back = True
        self._firsts.clear()
        return self.first_trials(menu, accuracy)

    def trial(
        self,
        family: Family,
        num_steps: int,
        accuracy: float | None = None,
        most_seconds: float = np.inf,
    ) -> Trial:
        """The first trial with a certified error, of 1, 2, 4, ... times the macro steps; the last trial if the search
        runs out of steps, or of time, `most_seconds`. With an accuracy its errors look at events, see `Trial.of`."""
        most = MOST_TRIAL_SECONDS
        while True:
            run = replace(self.run(family, num_steps), may_fall_back=self.falls_back)
            total = max(USUAL_TRIALS, self.num_trials + 1)
            self.progress(f"trial of {family.label(family.first)}, {run.num_steps} macro steps", self.num_trials, total)
            self.num_trials += 1
            elapsed = stopwatch()
            runs = run, run.in_pieces(), Events() if accuracy is None else self.drives, partial(companion, run)
            trial = Trial.of(*runs, accuracy or 0.0, family)
            self.note(trial)
            # The seconds of the first trial include compiling, which later trials do not repeat.
            is_late = elapsed() > most and run.num_steps > FEWEST_STEPS
            if np.isfinite(trial.error) or is_late or 2 * run.num_steps > MOST_STEPS:
                return trial
            num_steps, most = 2 * run.num_steps, min(most_seconds, MOST_TRIAL_SECONDS)

    def note(self, trial: Trial) -> None:
        """Called with each trial."""

    def accurate(self, trial: Trial, accuracy: float) -> Trial:
        """A trial of the same scheme that keeps the accuracy; the last one if `MOST_REPEATS` of them miss it."""
        order = 1.0 if self.drives.jump else float(trial.run.order)
        for _ in range(MOST_REPEATS):
            before, run = trial, trial.run
            if not np.isfinite(before.error):
                break
            wanted = min(before.steps_for(AIMED_PART * accuracy, order), MOST_GROWTH * run.num_steps)
            num_steps = self.beside_resonances(before, wanted)
            if num_steps > MOST_STEPS:
                break
            trial = self.trial(before.family, num_steps, accuracy)
            if trial.error <= accuracy:
                break
            order = self._observed_order(before, trial)
        return trial

    def _observed_order(self, before: Trial, after: Trial) -> float:
        """The order between two trials, from 1 to the order of the scheme: kinks of a force lower it. An error that
        grows, as beside a resonance of smooth forces, tells no order."""
        if not (before.error > 0 and 0 < after.error < np.inf) or before.run.num_steps == after.run.num_steps:
            return 1.0
        falls, grows = np.log(before.error / after.error), np.log(after.run.num_steps / before.run.num_steps)
        if falls <= 0 and not self.drives.jump:
            return float(after.run.order)
        return float(np.clip(falls / grows, 1.0, after.run.order))

    def rounded(self, num_steps: int) -> tuple[int, int]:
        """(num_steps, save_every): the number of macro steps, rounded up to a multiple of the saved intervals."""
        saves = self.num_saves or min(num_steps, MOST_SAVED)
        save_every = -(-num_steps // saves)
        if self.num_saves is None:
            saves = -(-num_steps // save_every)
            saves = -(-saves // FEWEST_DIVIDED) * FEWEST_DIVIDED if self.drives.names else saves
        return saves * save_every, save_every

    def run(self, family: Family, num_steps: int) -> Simulation:
        """The run with at least `num_steps` macro steps, and with steps that see all events."""
        key = family.expression
        if key not in self._runs:
            moving, state, solver = self._arguments
            run = simulation(moving, family.scheme, state, solver, self.length, num_steps=1)
            run.check()
            check_memory("simulate", run, num_saves=self.num_saves or MOST_SAVED)
            check_function_of_run(self._of, run)
            self._runs[key] = run
        fewest = fewest_steps(self._runs[key].scheme, self.drives, self.length)
        num_steps, save_every = self.rounded(max(num_steps, fewest))
        dt = np.asarray(self.length / num_steps)
        return replace(self._runs[key], macro_dt=dt, num_steps=num_steps, save_every=save_every)

    def extent(self) -> float:
        """Largest extent of the motion in the first trials whose errors are certified; NaN if there are none."""
        certified = [trial for trial in self._firsts.values() if np.isfinite(trial.error)]
        return max((extent_of(trial.trajectory) for trial in certified), default=np.nan)

    def time_for(self, trial: Trial, error: float) -> float:
        """Seconds of the steps of a run with this error; infinite if the error of the trial is not certified."""
        if not np.isfinite(trial.error):
            return np.inf
        if trial.family.expression not in self.seconds:
            self.measure([trial])
        return trial.steps_for(error) * self.seconds[trial.family.expression]

    def measure(self, trials: Sequence[Trial]) -> None:
        """Measure the seconds of a macro step of each trial, in turns."""
        for trial, seconds in zip(trials, seconds_of_steps(*[trial.run for trial in trials]), strict=True):
            self.seconds[trial.family.expression] = float(seconds)

    def warn_of_events(self, caller: str, scheme: SchemeLike) -> None:
        """Warn if the events of a driven system demand `MANY_STEPS` of a run."""
        drives, fewest = self.drives, fewest_steps(scheme, self.drives, self.length)
        if fewest > MANY_STEPS:
            warn_user(
                f"{caller}: {' and '.join(drives.names)} of the system changes and changes back within "
                f"{drives.shortest:.2g}, so that the run takes at least {fewest} macro steps until "
                f"t = {self.t_end:g}; a run in parts, with its steps for each part, takes fewer.",
            )

    def settings(self, trial: Trial) -> Settings:
        """The arguments of `vmri_jax.simulate` that repeat the run of a trial."""
        run, family, time = trial.run, trial.family, self._times.get(trial.family.python)
        numbers = float(run.macro_dt), run.num_steps, run.save_every
        gain = 1.0 if time is None else time(1) / time(family.first)
        return Settings(run.scheme, family.expression, family.options, *numbers, gain)

    def _with_best_num_micro(self, trial: Trial, error: float) -> Trial:
        """A trial with the number of micro steps of the least time; an interval of high degree stays single."""
        can_choose = self.has_two_rates and stage_scheme(trial.run.scheme).degree == 1
        if not (can_choose and 0 < trial.error < np.inf):
            return trial
        python, run = trial.family.python, trial.run
        if python not in self._chosen:
            finer = self.trial(replace(trial.family, first=2 * trial.family.first), run.num_steps)
            comparable = np.isfinite(finer.error) and finer.run.num_steps == run.num_steps
            trials = [trial, finer, *self._third(trial, finer)] if comparable else [trial]
            self._chosen[python] = min(trials, key=lambda candidate: self.time_for(candidate, error))
        return self._chosen[python]

    def _third(self, trial: Trial, finer: Trial) -> list[Trial]:
        """A trial with the number of micro steps of the least time for an error, ``N^(p + 1) = (a / b) (F / S)``, if it
        promises less time than the number N of a trial, and 2 N of a `finer` one with the same macro steps."""
        num_micro, p, run = trial.family.first, trial.order, trial.run
        slow, fast = (float(largest_of(share).max()) for share in trial.shares(finer.trajectory))
        slow, fast = max(slow, LEAST_SHARE * fast, np.finfo(float).tiny), num_micro**p * fast
        # time(N) = a + b N: b = (time(2 N) - time(N)) / N and a = time(N) - N b
        self.measure([trial, finer])
        seconds, finer_seconds = (self.seconds[t.family.expression] for t in (trial, finer))
        least = LEAST_TIME * seconds
        micro_seconds = max(finer_seconds - seconds, least) / num_micro
        macro_seconds = max(seconds - num_micro * micro_seconds, least)

        def time(n: int) -> float:
            """Time of a run with a given error, ``(a + b N) (S + F / N^p)^(1 / p)``, up to a factor without N."""
            return (macro_seconds + n * micro_seconds) * (slow + fast / n**p) ** (1 / p)

        self._times[trial.family.python] = time
        unit = unit_of(self.system, run.scheme)  # the rates of the rules divide num_micro
        best = (macro_seconds / micro_seconds * fast / slow) ** (1 / (p + 1))
        best = unit * int(np.clip(round(best / unit), 1, max(1, MOST_MICRO // unit)))
        num_steps = max(1, round(run.num_steps * num_micro / best))  # micro steps of the same length
        if num_steps > MOST_STEPS or min(time(num_micro), time(2 * num_micro)) < WORTH_COMPILING * time(best):
            return []
        return [self.trial(replace(trial.family, first=best), num_steps)]

    @cached_property
    def _linear(self) -> Linearisation | None:
        """The expansion of the system about its start; None for large systems, and for mechanisms whose drives
        prescribe all coordinates."""
        if self.start.q_s.size + self.start.q_f.size > MOST_COORDINATES:
            return None
        try:
            linear = linearise(self.system, self.start)
        except ValueError:
            return None
        return linear if linear.frequencies.size else None

    def beside_resonances(self, trial: Trial, num_steps: int) -> int:
        """This number of macro steps, or the next larger number for which small motions about the start do not grow."""
        if trial.family.first == 1 or self._linear is None:
            return num_steps
        longest = max(1.0, float(np.abs(stage_lengths(trial.run.scheme)).max())) * self.length / num_steps
        if self._linear.frequencies.max() * longest < LEAST_RESONANT_ANGLE:
            return num_steps
        # Imported here, since vmri_jax.stability imports matplotlib, which takes half a second.
        from vmri_jax.stability.multipliers import multipliers

        numbers = [self.rounded(int(np.ceil(num_steps / shorter)))[0] for shorter in SHORTER_STEPS]
        radii = multipliers(self._linear, trial.run.scheme, [self.length / n for n in numbers]).radius
        return next((n for n, radius in zip(numbers, radii, strict=True) if radius <= 1 + RESONANT_GROWTH), num_steps)

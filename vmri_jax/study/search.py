"""The staged search of `tune` and `cost_report`: the cheapest scheme, num_micro and number of macro steps for an error.

Stage 1 takes every family of `families` with its first num_micro and finds the fewest macro steps that keep the error;
it gives up a family as soon as its runs are much slower than the best setting so far. Stage 2 varies num_micro of the
best families, upwards and downwards as long as runs get faster, and tries one micro step. Stage 3 times the best
settings in turn.
"""

import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter

import numpy as np

from vmri_jax import diagnostics
from vmri_jax.accuracy.families import Family
from vmri_jax.mechanics.state import Problem
from vmri_jax.running.progress import Progress, silent
from vmri_jax.steppers.solver import Solver
from vmri_jax.study.program import Program
from vmri_jax.study.reference_solution import ReferenceSolution
from vmri_jax.study.work import WorkPrecision, WorkRow, timed_in_turn, work_row

NUM_MICRO = (1, 2, 3, 5, 8, 12, 20, 30, 50)
"""Numbers of micro steps per macro step that stage 2 tries."""
MAX_TIME_RATIO = 5.0
"""Give up a family whose runs still miss the error at this many times the time of the best setting; a larger ratio searches longer."""
FINALISTS = 4
"""Number of families that go to stage 2; stage 3 times twice as many settings. A larger number searches longer."""
STEPS_RATIO = 1.1
"""The number of steps that keeps the error is at most this many times a number that misses it; a ratio nearer 1 needs more runs."""
MAX_RUN_SECONDS = 5.0
"""Give up a family whose runs take longer and miss the error, even if nothing has kept it yet; a larger value searches longer."""
MAX_STEPS = 2**22
"""Most macro steps of a run; a larger number lets schemes of low order reach smaller errors, slowly."""
MAX_PROGRAMS = 64
"""Compiled schemes that a search holds in memory; with a smaller number the search compiles schemes twice."""
TIMED_RUNS = 5
"""Runs whose median is the time of a setting in stage 3; more of them make the order of the settings surer."""
by_seconds = attrgetter("row.seconds")


@dataclass(frozen=True)
class Setting:
    """A scheme with its num_micro and number of macro steps, and the row of its run: error and time."""

    family: Family
    num_micro: int
    num_steps: int
    row: WorkRow

    @property
    def scheme(self):
        """The scheme or composition."""
        return self.family.make(self.num_micro)

    @property
    def key(self) -> tuple[str, int, int]:
        """Name of the family, num_micro and number of macro steps."""
        return self.family.name, self.num_micro, self.num_steps

    def command(self, system: str) -> str:
        """The command line that simulates `system` with this setting."""
        step = f"--num-micro {self.num_micro} --macro-dt {self.row.macro_dt:.17g} --steps {self.num_steps}"
        return f"vmri simulate {system} {self.family.options} {step} --out run.npz"


def stopwatch() -> Callable[[], float]:
    """Return a function that gives the seconds since this call: wall time or processor time, the lesser.

    A busy machine then has the same time for a search as an idle one, and so has a machine with many cores.
    """
    wall_start, processor_start = time.monotonic(), time.process_time()
    return lambda: min(time.monotonic() - wall_start, time.process_time() - processor_start)


@dataclass
class Search:
    """Runs of one problem, each made once: programs, errors and times by family, num_micro and number of steps.

    Runs save as many nodes as the reference solution. Arguments are as of `Program`.
    """

    problem: Problem
    t_end: float
    menu: Sequence[Family]
    reference: ReferenceSolution
    solver: Solver | None = None
    fallback: bool = True
    programs: dict[tuple[str, int], Program] = field(default_factory=dict)
    settings: dict[tuple[str, int, int], Setting] = field(default_factory=dict)

    def __post_init__(self):
        self.frequency = float(diagnostics.frequencies(self.problem)[0])

    def program(self, family: Family, num_micro: int) -> Program:
        """The compiled scheme; the search keeps the MAX_PROGRAMS that were used last."""
        key = (family.name, num_micro)
        program = self.programs.pop(key, None)
        if program is None:
            scheme, num_saves = family.make(num_micro), self.reference.num_saves
            program = Program(self.problem, scheme, self.t_end, num_saves, self.solver, self.fallback)
        self.programs[key] = program  # at the end of the dictionary: the first entry is the one not used for longest
        if len(self.programs) > MAX_PROGRAMS:
            self.programs.pop(next(iter(self.programs)))
        return program

    def run(self, family: Family, num_micro: int, num_steps: int) -> Setting:
        """The setting with the error of its run and a first estimate of its time, the lesser of two samples."""
        key = (family.name, num_micro, num_steps)
        if key not in self.settings:
            program = self.program(family, num_micro)
            fastest = min(program.seconds(num_steps, 2, 0.0))
            row = work_row(family.label(num_micro), program, num_steps, self.reference).timed([fastest])
            self.settings[key] = Setting(family, num_micro, num_steps, row)
        return self.settings[key]

    def reach(self, family: Family, num_micro: int, error: float, limit: float) -> Setting | None:
        """The fewest steps that keep the error, within STEPS_RATIO; None if runs that miss it take longer than `limit` seconds.

        The error of a scheme of order r falls like n^-r, so that a run with n steps whose error is m times the accepted
        one predicts ``n m^(1/r)`` steps. The prediction is kept between the most steps that missed the error and the
        fewest that kept it.
        """
        unit, order = self.reference.num_saves, family.make(num_micro).order  # numbers of steps are n * unit
        n = max(1, round(family.coarsest(num_micro, self.frequency, self.t_end) / unit))
        too_few, enough, best = 0, MAX_STEPS // unit, None
        while n <= MAX_STEPS // unit:
            setting = self.run(family, num_micro, n * unit)
            miss = setting.row.error_q / error
            if miss <= 1:
                enough, best = n, setting
            else:
                too_few = n
                if best is None and setting.row.seconds > limit:
                    return None
            if best is not None and enough <= max(too_few + 1, STEPS_RATIO * too_few):
                return best
            # 3 % more than predicted, since a run that just misses the error is of no use; a failed run (NaN) tells no error
            n = round(n * np.clip(1.03 * miss ** (1 / order), 0.25, 4)) if np.isfinite(miss) else 2 * n
            if best is not None and not too_few < n < enough:  # errors do not fall with the order here: bisect log n
                n = min(max(round(np.sqrt(max(too_few, enough / 4) * enough)), too_few + 1), enough - 1)
            n = max(n, too_few + 1)
        return best

    def by_promise(self, error: float) -> list[Family]:
        """The menu, sorted: first the families whose order is near the number of digits that the error asks for.

        Lower orders take many steps, and higher orders take long to compile.
        """
        motion = float(np.abs(self.reference.q - self.reference.q[0]).max())
        digits = max(2.0, np.log10(motion / error)) if motion > 0 else 2.0
        return sorted(self.menu, key=lambda family: abs(np.log(family.make(family.first).order / digits)))

    def cheapest(
        self, error: float, progress: Progress = silent, exhaustive: bool = False, budget: float = np.inf
    ) -> list[Setting]:
        """Settings that keep the error, the fastest first; the best ones are timed in turn.

        `budget` are the seconds after which the search compiles no further scheme, once a setting keeps the error.
        """
        reached: dict[tuple[str, int], Setting] = {}
        limit, elapsed = MAX_RUN_SECONDS, stopwatch()
        total = len(self.menu) + FINALISTS

        def attempt(family: Family, num_micro: int, done: int) -> Setting | None:
            nonlocal limit
            key = (family.name, num_micro)
            if reached and key not in self.programs and elapsed() > budget:
                return None
            progress(f"{family.label(num_micro)} at {error:.0e}", done, total)
            setting = self.reach(family, num_micro, error, limit)
            if setting is not None:
                reached[key] = setting
                limit = min(limit, (10 if exhaustive else 1) * MAX_TIME_RATIO * setting.row.seconds)
            return setting

        def climb(best: Setting, candidates: Sequence[int], done: int) -> None:
            """Try numbers of micro steps in turn until a run is slower by more than the 5 % by which times scatter."""
            for num_micro in candidates:
                setting = attempt(best.family, num_micro, done)
                if setting is None or setting.row.seconds > 1.05 * best.row.seconds:
                    return
                best = setting

        # stage 1: every family
        for i, family in enumerate(self.by_promise(error)):
            for num_micro in NUM_MICRO if exhaustive else (family.first,):
                attempt(family, num_micro, i)
        # stage 2: num_micro of the best families
        firsts = [] if exhaustive else sorted(reached.values(), key=by_seconds)[:FINALISTS]
        for done, first in enumerate(firsts, start=len(self.menu)):
            attempt(first.family, 1, done)  # `climb` may stop above 1, where slow and fast variables share their grid
            climb(first, [n for n in NUM_MICRO if n > first.num_micro], done)
            climb(first, [n for n in reversed(NUM_MICRO) if n < first.num_micro], done)
        # stage 3: times in turn
        ranked = sorted(reached.values(), key=by_seconds)
        timed = self._timed(ranked[: 2 * FINALISTS])
        timed += self._timed(self._rivals(error, timed))
        return sorted(timed, key=by_seconds) + ranked[2 * FINALISTS :]

    def _rivals(self, error: float, timed: Sequence[Setting]) -> list[Setting]:
        """Settings outside `timed` that keep the error, and whose first estimate of a time is below the best time in `timed`."""
        timed_keys = {s.key for s in timed}
        best = min((s.row.seconds for s in timed), default=0.0)
        untimed = [setting for key, setting in self.settings.items() if key not in timed_keys]
        return [s for s in untimed if s.row.error_q <= error and s.row.seconds < best]

    def time_again(self, labels: Collection[str]) -> None:
        """Time all runs of the schemes with these labels in turn."""
        self._timed([s for s in self.settings.values() if s.row.scheme in labels and np.isfinite(s.row.error_q)])

    def _timed(self, settings: Sequence[Setting]) -> list[Setting]:
        """The settings with medians of TIMED_RUNS runs that took turns; the search keeps the new times."""
        runs = [(self.program(s.family, s.num_micro), s.row) for s in settings]
        rows = timed_in_turn(runs, TIMED_RUNS)
        timed = [replace(s, row=row) for s, row in zip(settings, rows, strict=True)]
        self.settings |= {s.key: s for s in timed}
        return timed

    def not_tried(self) -> list[str]:
        """Names of the families without any run: the search had no time left for them."""
        tried = {s.family.name for s in self.settings.values()}
        return [family.name for family in self.menu if family.name not in tried]

    def rows(self) -> WorkPrecision:
        """All runs so far, sorted by family, num_micro and number of steps."""
        settings = sorted(self.settings.values(), key=lambda s: s.key)
        return WorkPrecision(tuple(s.row for s in settings), self.t_end, self.reference)

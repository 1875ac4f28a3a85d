"""The cheapest setting for the error one can accept: a staged search over schemes, num_micro and macro steps.

Stage 1 takes every family of `families.families` with its first num_micro and finds the largest macro step that keeps the
error, giving up on a family as soon as it is much slower than the best so far. Stage 2 varies num_micro of the best
families, uphill from where they stand, and tries them with one micro step. Stage 3 times the best settings in turn.
"""

import time
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from typing import Any

import jax
import numpy as np

from vmri_jax import diagnostics
from vmri_jax.accuracy.families import Family, families
from vmri_jax.mechanics.projection import legendre, project_momentum
from vmri_jax.mechanics.state import HasProblem, Problem, State, problem_of
from vmri_jax.running.interrupts import Interrupted
from vmri_jax.running.progress import Progress, shows_progress, silent
from vmri_jax.steppers.results import SimulationError
from vmri_jax.steppers.solvers import Newton
from vmri_jax.study.program import Program
from vmri_jax.study.reference_solution import ReferenceSolution, reference_solution
from vmri_jax.study.table import ResultTable
from vmri_jax.study.work import WorkPrecision, WorkRow, duration, timed_in_turn, work_row

NUM_MICRO = (1, 2, 3, 5, 8, 12, 20, 30, 50)
PATIENCE = 5.0
"""Time of a setting over that of the best one above which it is given up; a larger ratio searches longer."""
KEPT = 4
"""Families that go to stage 2, settings that go to stage 3."""
CLOSE = 1.1
"""The number of steps is found within this factor."""
MARGIN = 10.0
"""Least ratio of the error asked for to that of the reference: below it, errors of runs are those of the reference."""
SHOWN = 5
"""Settings that a recommendation and `vmri tune` print."""
SHAKE = 0.01
"""Velocities of the other start differ by about this part: the motion is another one, with the same time scales."""
LUCK = 2.0
"""Ratio of the error from another start to that from the first one above which a setting was good by luck, and the next one is tried."""
LONGEST = 5.0
"""Seconds of a run after which a setting is given up, whatever the others take."""
MAX_STEPS = 2**22
PROGRAMS = 64
"""Compiled schemes that a search holds at once."""


@dataclass(frozen=True)
class Setting:
    """A scheme with its num_micro and number of macro steps, and what a run of it gave."""

    family: Family
    num_micro: int
    num_steps: int
    row: WorkRow

    @property
    def scheme(self):
        """The scheme itself."""
        return self.family.make(self.num_micro)

    def command(self, system: str) -> str:
        """The command that runs it."""
        step = f"--num-micro {self.num_micro} --macro-dt {self.row.macro_dt:.17g} --steps {self.num_steps}"
        return f"vmri simulate {system} {self.family.options} {step} --out run.npz"


def stopwatch() -> Callable[[], float]:
    """A function of the seconds that have passed: of the clock or of the processor, the fewer. A busy machine has the same time for a search as an idle one,
    and so has one of many cores."""
    begun = time.monotonic(), time.process_time()
    return lambda: min(time.monotonic() - begun[0], time.process_time() - begun[1])


def _seconds(setting: Setting) -> float:
    return setting.row.seconds


class NothingReached(ValueError):
    """No setting reached the error; what was run is in `.runs`."""

    def __init__(self, message: str, runs: WorkPrecision):
        self.runs = runs
        super().__init__(message)


class Search:
    """Runs of one problem, each done once: programs, errors and times by family, num_micro and number of steps.

    Args:
        problem: system and start.
        t_end: simulated time.
        menu: families to choose from.
        reference: what runs are compared with; its number of nodes is that of the runs.
        solver: how implicit equations are solved.
        fallback: as of `Program`.
    """

    def __init__(
        self,
        problem,
        t_end: float,
        menu: Sequence[Family],
        reference: ReferenceSolution,
        solver: Newton | None = None,
        fallback: bool = True,
    ):
        self.problem, self.t_end, self.menu, self.reference = problem, t_end, menu, reference
        self.solver, self.fallback = solver, fallback
        self.frequency = float(diagnostics.frequencies(problem)[0])
        self.programs: dict[tuple[str, int], Program] = {}
        self.settings: dict[tuple[str, int, int], Setting] = {}

    def program(self, family: Family, num_micro: int) -> Program:
        """The compiled scheme; the last PROGRAMS of them are kept."""
        key = (family.name, num_micro)
        program = self.programs.pop(key, None)
        if program is None:
            given = self.problem, family.make(num_micro), self.t_end, self.reference.num_saves, self.solver
            program = Program(*given, self.fallback)
        self.programs[key] = program  # the last one now
        if len(self.programs) > PROGRAMS:
            self.programs.pop(next(iter(self.programs)))
        return program

    def at(self, family: Family, num_micro: int, num_steps: int) -> Setting:
        """The run with these settings and a first idea of its time."""
        key = (family.name, num_micro, num_steps)
        if key not in self.settings:
            program = self.program(family, num_micro)
            fastest = min(program.seconds(num_steps, 2, 0.0))
            row = work_row(family.label(num_micro), program, num_steps, self.reference).timed([fastest])
            self.settings[key] = Setting(family, num_micro, num_steps, row)
        return self.settings[key]

    def reach(self, family: Family, num_micro: int, error: float, limit: float) -> Setting | None:
        """The fewest steps that keep the error; None if runs that do not keep it take longer than `limit` seconds.

        The next number of steps is guessed from the order of the scheme and kept between those that were too few and
        those that were enough.
        """
        unit, order = self.reference.num_saves, family.make(num_micro).order
        n = max(1, round(family.coarsest(num_micro, self.frequency, self.t_end) / unit))
        too_few, enough, best = 0, MAX_STEPS // unit, None
        while n <= MAX_STEPS // unit:
            setting = self.at(family, num_micro, n * unit)
            miss = setting.row.error_q / error
            if miss <= 1:
                enough, best = n, setting
            else:
                too_few = n
                if best is None and setting.row.seconds > limit:
                    return None
            if best is not None and enough <= max(too_few + 1, CLOSE * too_few):
                return best
            n = round(n * np.clip(1.03 * miss ** (1 / order), 0.25, 4)) if np.isfinite(miss) else 2 * n
            if best is not None and not too_few < n < enough:  # the order misleads
                n = min(max(round(np.sqrt(max(too_few, enough / 4) * enough)), too_few + 1), enough - 1)
            n = max(n, too_few + 1)
        return best

    def by_promise(self, error: float) -> list[Family]:
        """The menu; first the families whose order is about the number of digits asked for.

        Lower orders take many steps, and higher ones long to compile.
        """
        motion = float(np.abs(self.reference.q - self.reference.q[0]).max())
        digits = max(2.0, np.log10(motion / error)) if motion > 0 else 2.0
        return sorted(self.menu, key=lambda family: abs(np.log(family.make(family.first).order / digits)))

    def cheapest(
        self, error: float, progress: Progress = silent, exhaustive: bool = False, budget: float = np.inf
    ) -> list[Setting]:
        """Settings that keep the error, the fastest first, the first KEPT of them timed in turn.

        Args:
            exhaustive: try every num_micro of every family, to check the staged search.
            budget: seconds after which nothing more is compiled, once something has kept the error.
        """
        reached: dict[tuple[str, int], Setting] = {}
        limit, elapsed = LONGEST, stopwatch()

        total = len(self.menu) + KEPT

        def attempt(family: Family, num_micro: int, done: int) -> Setting | None:
            nonlocal limit
            key = (family.name, num_micro)
            if reached and key not in self.programs and elapsed() > budget:
                return None
            progress(f"{family.label(num_micro)} at {error:.0e}", done, total)
            setting = self.reach(family, num_micro, error, limit)
            if setting is not None:
                reached[key] = setting
                limit = min(limit, (10 if exhaustive else 1) * PATIENCE * setting.row.seconds)
            return setting

        def climb(best: Setting, upwards: Sequence[int], done: int) -> None:
            for num_micro in upwards:
                setting = attempt(best.family, num_micro, done)
                if setting is None or setting.row.seconds > 1.05 * best.row.seconds:
                    return
                best = setting

        for i, family in enumerate(self.by_promise(error)):
            for num_micro in NUM_MICRO if exhaustive else (family.first,):
                attempt(family, num_micro, i)
        firsts = [] if exhaustive else sorted(reached.values(), key=_seconds)[:KEPT]
        for done, first in enumerate(firsts, start=len(self.menu)):
            attempt(first.family, 1, done)  # a case of its own: slow and fast share their grid
            climb(first, [n for n in NUM_MICRO if n > first.num_micro], done)
            climb(first, [n for n in reversed(NUM_MICRO) if n < first.num_micro], done)
        ranked = sorted(reached.values(), key=_seconds)
        timed = self._timed(ranked[: 2 * KEPT])
        timed += self._timed(self._rivals(error, timed))
        return sorted(timed, key=_seconds) + ranked[2 * KEPT :]

    def _rivals(self, error: float, timed: Sequence[Setting]) -> list[Setting]:
        """Settings that kept the error on the way, and whose first idea of a time is below the best of those timed."""
        seen = {(s.family.name, s.num_micro, s.num_steps) for s in timed}
        best = min((s.row.seconds for s in timed), default=0.0)
        others = [setting for key, setting in self.settings.items() if key not in seen]
        return [s for s in others if s.row.error_q <= error and s.row.seconds < best]

    def time_again(self, labels: Collection[str]) -> None:
        """Time all runs of these schemes in turn."""
        self._timed([s for s in self.settings.values() if s.row.scheme in labels and np.isfinite(s.row.error_q)])

    def _timed(self, settings: Sequence[Setting]) -> list[Setting]:
        """The same with medians of runs that took turns."""
        runs = [(self.program(s.family, s.num_micro), s.row) for s in settings]
        found = [replace(s, row=row) for s, row in zip(settings, timed_in_turn(runs, 5), strict=True)]
        self.settings |= {(s.family.name, s.num_micro, s.num_steps): s for s in found}
        return found

    @contextmanager
    def kept(self) -> Iterator[None]:
        """Within, Ctrl-C raises `Interrupted`, with all runs so far."""
        try:
            yield
        except KeyboardInterrupt:
            rows = self.rows()
            raise Interrupted(rows, len(rows.rows), None, "runs") from None

    def not_tried(self) -> list[str]:
        """Families of which nothing has been run, as where the time of the search was over before."""
        tried = {s.family.name for s in self.settings.values()}
        return [family.name for family in self.menu if family.name not in tried]

    def rows(self) -> WorkPrecision:
        """All runs so far."""
        order = sorted(self.settings.values(), key=lambda s: (s.family.name, s.num_micro, s.num_steps))
        return WorkPrecision(tuple(s.row for s in order), self.t_end, self.reference)


@dataclass(frozen=True)
class Verification:
    """A run with another start, not seen by the search: its error and time over those predicted."""

    error_q: float
    seconds: float
    error_ratio: float
    time_ratio: float


@dataclass(frozen=True)
class Recommendation(ResultTable):
    """The cheapest setting found for an error, and how it was found; it prints as a table of the best few settings.

    Its files, `to_csv` and `to_json`, hold all runs of the search.

    scheme, macro_dt, num_steps: what to give to `vmri_jax.running.simulate`.
    setting: the same with its error and time; others: the runners-up, the fastest first.
    verification: the same setting from another start.
    runs: all runs of the search; ``runs.pareto()`` is their Pareto front.
    """

    error: float
    setting: Setting
    others: tuple[Setting, ...]
    verification: Verification | None
    runs: WorkPrecision
    columns = WorkPrecision.columns

    @property
    def rows(self) -> tuple[WorkRow, ...]:
        """All runs of the search."""
        return self.runs.rows

    def shown(self) -> list[WorkRow]:
        """The best settings, the choice first."""
        return [setting.row for setting in (self.setting, *self.others)[:SHOWN]]

    @property
    def caption(self) -> str:
        """What to run, and what it gave from another start."""
        seen = self.verification
        again = f" From another start its error is {seen.error_q:.1e}, in {duration(seen.seconds)}." if seen else ""
        return (
            f"For an error of {self.error:g} take the first: its .scheme, .macro_dt and .num_steps.{again} "
            f"All {len(self.rows)} runs are in .runs and .to_csv(path)."
        )

    def content(self) -> dict[str, Any]:
        """The choice, and all that the JSON file of the runs holds."""
        chosen = {"error": self.error, "choice": asdict(self.setting.row)}
        return {**self.runs.content(), **chosen}

    @property
    def scheme(self):
        """The scheme or composition."""
        return self.setting.scheme

    @property
    def macro_dt(self) -> float:
        """Macro step H."""
        return self.setting.row.macro_dt

    @property
    def num_steps(self) -> int:
        """Macro steps up to t_end."""
        return self.setting.num_steps


def round_off(problem: Problem) -> tuple[float, float]:
    """The largest position at the start, and what round-off alone makes of it in a run."""
    size = float(max(np.abs(problem.q_s).max(initial=0), np.abs(problem.q_f).max(initial=0), 1e-300))
    return size, 100 * np.finfo(float).eps * size


def check_target(error: float, t_end: float, problem: Problem) -> None:
    """Refuse errors and times that no run can meet."""
    if not (np.isfinite(t_end) and t_end > 0):
        raise ValueError(f"tune: t_end is {t_end}; it must be a positive number.")
    size, floor = round_off(problem)
    if not (np.isfinite(error) and error > floor):
        raise ValueError(
            f"tune: error is {error:g}; the largest position is {size:.3g}, so that round-off alone is about "
            f"{floor:.0e}. Give a larger error, in the unit of the positions."
        )


@shows_progress
def tune(
    problem: Problem | HasProblem,
    error: float,
    t_end: float,
    *,
    menu: Sequence[Family] | None = None,
    num_saves: int = 1,
    reference: ReferenceSolution | None = None,
    solver: Newton | None = None,
    verify: bool = True,
    exhaustive: bool = False,
    progress: Any = False,
) -> Recommendation:
    """Find the scheme, num_micro and macro step that reach an error in the least time on this machine.

    Args:
        problem: system and start; a `Problem` or a scene.
        error: largest accepted ``|q - q_ref|`` over the compared nodes, in the unit of the positions.
        t_end: simulated time.
        menu: families to choose from, by default `families()`.
        num_saves: nodes compared, equally spaced; 1 compares at t_end.
        reference: compare with this; by default `reference_solution`.
        solver: how implicit equations are solved.
        verify: run the setting from another start, and compare with its own reference.
        exhaustive: search without shortcuts.
        progress: True for a bar, or a function (what, done, total) that is told about every attempt.

    Raises:
        ValueError: an error below round-off or below what the reference can tell.
        NothingReached: no setting keeps the error; carries the runs.
        SimulationError: the reference could not be computed.
        Interrupted: Ctrl-C during the search; carries the runs.

    Warns:
        UserWarning: the setting was found, but could not be checked from another start.
    """
    problem = problem_of("tune", problem)
    check_target(error, t_end, problem)
    if reference is None:
        reference = reference_solution(problem, t_end, num_saves=num_saves, progress=progress)
    if error < MARGIN * reference.error_q:
        raise ValueError(
            f"tune: error is {error:g}, but the reference solution is only good to {reference.error_q:.1e}: runs with half the "
            f"step come no closer, as where a motion is chaotic. Give a smaller t_end, an error of at least "
            f"{MARGIN * reference.error_q:.1e}, or a better reference."
        )
    for fallback in (False, True):  # runs that need it are seldom the cheapest, and it takes long to compile
        search = Search(problem, t_end, families() if menu is None else menu, reference, solver, fallback)
        with search.kept():
            found = search.cheapest(error, progress, exhaustive)
        if found:
            break
    else:
        best = min(search.settings.values(), key=lambda s: np.nan_to_num(s.row.error_q, nan=np.inf))
        raise NothingReached(
            f"tune: no setting reached {error:g} in {len(search.settings)} runs; the best error was "
            f"{best.row.error_q:.1e}, with {best.row.scheme} and {best.num_steps} steps. Give a larger error.",
            search.rows(),
        )
    chosen, checked = found[0], None
    if verify:
        progress("another start", 1, 1)
        try:
            with search.kept():
                chosen, checked = _not_by_luck(found, _from_another_start(problem, t_end, reference, solver))
        except SimulationError as failure:
            warnings.warn(
                f"tune: the setting is not checked from another start, for the reference solution fails there: {failure}",
                stacklevel=2,
            )
    progress("done", 1, 1)
    others = tuple(setting for setting in found if setting is not chosen)
    return Recommendation(error, chosen, others, checked, search.rows())


def _not_by_luck(found: Sequence[Setting], verified: Callable[[Setting], Verification]) -> tuple[Setting, Verification]:
    """The first of the best settings whose error is not small by chance; the very first one where all are."""
    for setting in found[:KEPT]:
        checked = verified(setting)
        if checked.error_ratio <= LUCK:
            return setting, checked
    return found[0], verified(found[0])


def another_start(problem: Problem, speed: float) -> Problem:
    """The problem with velocities that differ by about a hundredth, and that fit its constraints, the moving ones too.

    The velocities get random differences; the momenta that belong to them are projected onto the hidden constraints.

    Args:
        problem: of the search.
        speed: mean speed of the run: the size of velocities where the run starts at rest.
    """
    system, state, random = problem.system, problem.state(), np.random.default_rng(1)
    at_start = problem.v_s, problem.v_f
    size = SHAKE * max(speed, *(float(np.abs(v).max(initial=0.0)) for v in at_start))
    shaken = [np.asarray(v) + size * random.normal(size=np.shape(v)) for v in at_start]
    momenta = legendre(system, state.q_s, state.q_f, *shaken)
    *_, v_s, v_f = jax.jit(project_momentum)(system, State(state.t, state.q_s, state.q_f, *momenta), at_start)
    return replace(problem, q_s=state.q_s, q_f=state.q_f, v_s=v_s, v_f=v_f, project=False)


def _from_another_start(
    problem: Problem, t_end: float, seen: ReferenceSolution, solver
) -> Callable[[Setting], Verification]:
    """Runs a setting from another start, which the search has not seen."""
    num_saves = seen.num_saves
    other = another_start(problem, float(np.abs(seen.q - seen.q[0]).max()) / t_end)
    reference = reference_solution(other, t_end, num_saves=num_saves)

    def verified(setting: Setting) -> Verification:
        program = Program(other, setting.scheme, t_end, num_saves, solver)
        seconds = program.seconds(setting.num_steps, 5)
        row, known = work_row(setting.row.scheme, program, setting.num_steps, reference).timed(seconds), setting.row
        grown = row.error_q / known.error_q if known.error_q else 1.0  # no error at all: nothing moves
        return Verification(row.error_q, row.seconds, grown, row.seconds / known.seconds)

    return verified

"""Advice: the scheme, num_micro and macro step that reach an accepted error in the least time, from the search for an
accuracy over a whole menu.

Settings are checked by runs from another start, the fastest first, and the first one that keeps the error there too is
recommended: at one start an error may be small by chance, as where its leading term changes sign.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any

import jax
import numpy as np

from vmri_jax.accuracy.families import Family, by_promise, families, for_system
from vmri_jax.accuracy.search import Trial
from vmri_jax.accuracy.steps import check_error, digits_of, reached, search_of, warn_of_events
from vmri_jax.mechanics.projection import legendre, project_momentum
from vmri_jax.mechanics.state import HasProblem, Problem, State, problem_of
from vmri_jax.refusals import Refused
from vmri_jax.running.failures import simulation_error
from vmri_jax.running.progress import Progress, shows_progress, silent
from vmri_jax.steppers.solver import Solver
from vmri_jax.study.row import Row, RunTable, row_of
from vmri_jax.study.table import interruptible
from vmri_jax.study.work import WorkPrecision

FINALISTS = 4
"""Families whose micro steps and steps are searched for, of those that promise the least time. A larger number searches
longer."""
SETTINGS_PRINTED = 5
"""Number of settings, the recommended one included, that a recommendation and `vmri tune` print."""
RELATIVE_VELOCITY_CHANGE = 0.01
"""Standard deviation of the change of velocities over the largest velocity. The motion is another one with the same
time scales; a larger change may lead to a motion of another kind, with another error."""
MORE_STEPS = 1.1
"""Steps of a setting that misses the error from another start, over the steps that its miss predicts; a smaller number
needs more checks, a larger one leads to slower settings."""
MAX_CHECKS = 8
"""Settings that are checked, the fastest first, until one keeps the error from another start; a larger number searches
longer in vain."""


class Tuning:
    """A search over a menu for the errors of a problem, and a row for each of its runs; arguments as of `tune`."""

    def __init__(
        self,
        problem: Problem,
        t_end: float,
        menu: Sequence[Family] | None = None,
        num_saves: int | None = None,
        solver: Solver | None = None,
        progress: Progress = silent,
    ):
        self.problem, self.t_end, self.solver = problem, t_end, solver
        self.search = search_of(problem, None, solver, problem.t + t_end, num_saves, progress=progress)
        self.search.seen = self._add
        whole = families() if menu is None else menu
        self.menu = for_system(whole, self.search.system, self.search.has_two_rates)
        self._seen: dict[tuple[str, int], tuple[Family, Row]] = {}

    def _add(self, trial: Trial) -> None:
        """Add the row of a trial; a failed or uncertified run has an error of NaN."""
        run, error = trial.run, trial.error if np.isfinite(trial.error) else np.nan
        label, numbers = trial.family.label(trial.num_micro), (float(run.macro_dt), run.num_steps)
        measured = {"error_q": error, "settings": self.search.settings(trial)}
        row = row_of(label, run.system, run.scheme, trial.trajectory, *numbers, **measured)
        self._seen[trial.python, run.num_steps] = trial.family, row

    def extent(self) -> float:
        """How far the system moves in the first trials, of the first family if there are none yet; NaN if no error of
        them is certified."""
        if not self.search.extent() > 0:
            self.search.first_trials(self.menu[:1], np.inf)
        return self.search.extent()

    def look_for(self, name: str, error: float, exhaustive: bool = False) -> list[Row]:
        """Search for an error, and return the runs that keep it, the fastest first; `name` begins messages."""
        menu = by_promise(self.menu, digits_of(self.search, error))
        finals = reached(name, self.search, menu, error, finalists=FINALISTS, exhaustive=exhaustive)
        self.search.measure([trial for trial in finals if np.isfinite(trial.error)])
        return self.keeping(error)

    def family_of(self, row: Row) -> Family:
        """The family of the scheme of a run."""
        return next(family for family, seen in self._seen.values() if seen.scheme == row.scheme)

    def rows(self) -> list[Row]:
        """All runs so far, sorted by scheme and number of steps; seconds are those of the steps, NaN where they were
        not measured."""
        rows = sorted((row for _, row in self._seen.values()), key=attrgetter("scheme", "num_steps"))
        seconds = self.search.seconds
        return [replace(row, seconds=seconds.get(row.settings.python, np.nan) * row.num_steps) for row in rows]

    def keeping(self, error: float) -> list[Row]:
        """The runs that keep an error and whose time is known, the fastest first."""
        kept = [row for row in self.rows() if row.error_q <= error and np.isfinite(row.seconds)]
        return sorted(kept, key=attrgetter("seconds"))

    def runs(self) -> WorkPrecision:
        """The table of all runs so far."""
        return WorkPrecision(tuple(self.rows()))


class NothingReached(ValueError):
    """No setting kept the error; `.runs` has the runs of the search."""

    def __init__(self, message: str, runs: WorkPrecision):
        self.runs = runs
        super().__init__(message)


@dataclass(frozen=True)
class Verification:
    """A run from another start: its error, infinite if it is not certified, and the ratio of the error to the error in
    the search."""

    error_q: float
    error_ratio: float


@dataclass(frozen=True)
class Recommendation(RunTable):
    """The cheapest setting for an error, and the search that led to it; prints as a table of the best few settings.

    `to_csv` and `to_pandas` have all runs of the search.

    scheme, macro_dt, num_steps: arguments for `vmri_jax.simulate`; `setting.settings.arguments` are all of them.
    error: the accepted error, in the unit of the positions.
    setting: the recommended run, with its error and time.
    others: the runners-up, the fastest first.
    verification: the same scheme and steps from another start; None if it was not checked.
    runs: all runs of the search; ``runs.pareto()`` is their Pareto front.
    """

    error: float
    setting: Row
    others: tuple[Row, ...]
    verification: Verification | None
    runs: WorkPrecision
    columns = WorkPrecision.columns

    @property
    def rows(self) -> tuple[Row, ...]:
        """All runs of the search."""
        return self.runs.rows

    def shown(self) -> list[Row]:
        """The best settings, the recommended one first."""
        return [self.setting, *self.others][:SETTINGS_PRINTED]

    @property
    def caption(self) -> str:
        """The recommended setting, and its error from another start."""
        again = f" From another start its error is {self.verification.error_q:.1e}." if self.verification else ""
        return (
            f"For an error of {self.error:g} take the first: its .scheme, .macro_dt and .num_steps.{again} "
            f"All {len(self.rows)} runs are in .runs and .to_csv(path)."
        )

    @property
    def scheme(self):
        """The scheme or composition."""
        return self.setting.settings.scheme

    @property
    def macro_dt(self) -> float:
        """Macro step H."""
        return self.setting.macro_dt

    @property
    def num_steps(self) -> int:
        """Macro steps up to t_end."""
        return self.setting.num_steps


def check_target(error: float, t_end: float, problem: Problem) -> None:
    """Refuse errors and times that no run can meet."""
    if not (np.isfinite(t_end) and t_end > 0):
        raise Refused(f"tune: t_end is {t_end}; it must be a positive number.")
    check_error("tune: error", error, problem)


@shows_progress
def tune(
    problem: Problem | HasProblem,
    error: float,
    t_end: float,
    *,
    menu: Sequence[Family] | None = None,
    num_saves: int | None = None,
    solver: Solver | None = None,
    verify: bool = True,
    exhaustive: bool = False,
    progress: Any = False,
) -> Recommendation:
    """Find the scheme, num_micro and macro step that reach an error in the least time on this machine.

    Errors are those of ``simulate(..., error=True)``: estimated by companion runs, the largest over all positions and
    saved nodes, and certified.

    Args:
        problem: system and start; a `Problem` or a scene.
        error: largest accepted error of a position, in the unit of the positions, from this start and from another one.
        t_end: simulated time.
        menu: families to choose from, by default `families()`.
        num_saves: saved intervals, equally spaced, at whose ends errors are compared; None for one per macro step, at
            most 1000.
        solver: how implicit equations are solved.
        verify: run settings from another start, too, and recommend one that keeps the error there.
        exhaustive: try every num_micro of every family, to check the staged search.
        progress: True for a bar, or a function (what, done, total) that is told about every trial run.

    Raises:
        ValueError: an error below round-off, or above the extent of the motion.
        NothingReached: no setting keeps the error; carries the runs.
        SimulationError: the runs of all families fail.
        Interrupted: Ctrl-C during the search; carries the runs.

    Warns:
        UserWarning: no setting keeps the error from another start; events of forces demand many steps.
    """
    problem = problem_of("tune", problem)
    check_target(error, t_end, problem)
    tuning = Tuning(problem, t_end, menu, num_saves, solver, progress)
    tuning.search.fewest = True
    with interruptible(tuning.runs):
        rows = tuning.look_for("tune: error", error, exhaustive)
        if not rows:
            raise _nothing(tuning, error)
        setting, verification = rows[0], None
        if verify:
            mean_speed = tuning.extent() / t_end
            setting, verification = first_verified(tuning, rows, error, another_start(problem, mean_speed))
    progress("done", 1, 1)
    others = tuple(row for row in tuning.keeping(error) if row.settings != setting.settings)
    return Recommendation(error, setting, others, verification, tuning.runs())


def _nothing(tuning: Tuning, error: float) -> Exception:
    """The reason why no setting keeps the error: all runs failed, or none is as accurate."""
    rows, trial = tuning.rows(), tuning.search.first_trials(tuning.menu, error)[0]
    if all(row.result not in ("CONVERGED", "CONVERGED_AT_ROUNDOFF") for row in rows):
        return simulation_error(trial.trajectory, trial.run.macro_dt, trial.run.save_every, trial.run.scheme.num_micro)
    best = min(rows, key=lambda row: np.nan_to_num(row.error_q, nan=np.inf))
    certified = f"the best error was {best.error_q:.1e}, with {best.scheme} and {best.num_steps} steps"
    reason = certified if np.isfinite(best.error_q) else "no error is certified until t_end"
    text = f"tune: no setting reached {error:g} in {len(rows)} runs; {reason}. Give a larger error or a shorter t_end."
    return NothingReached(text, tuning.runs())


def another_start(problem: Problem, speed: float) -> Problem:
    """The problem with velocities that differ by about a hundredth and satisfy its constraints, moving ones included.

    Random numbers are added to the velocities; the momenta of the sums are projected onto the hidden constraints
    ``G v + dg/dt = 0``. `speed` is the mean speed of the run: the size of velocities where the run starts at rest.
    """
    system, state, random = problem.system, problem.state(), np.random.default_rng(1)
    velocities = problem.v_s, problem.v_f
    size = RELATIVE_VELOCITY_CHANGE * max(speed, *(float(np.abs(v).max(initial=0.0)) for v in velocities))
    changed = [np.asarray(v) + size * random.normal(size=np.shape(v)) for v in velocities]
    momenta = legendre(system, state.q_s, state.q_f, *changed)
    *_, v_s, v_f = jax.jit(project_momentum)(system, State(state.t, state.q_s, state.q_f, *momenta), velocities)
    return replace(problem, q_s=state.q_s, q_f=state.q_f, v_s=v_s, v_f=v_f, project=False)


def first_verified(tuning: Tuning, rows: Sequence[Row], error: float, other: Problem) -> tuple[Row, Verification]:
    """The fastest setting whose run from another start, too, keeps the error; warns if none of `MAX_CHECKS` settings
    does.

    A setting that misses the error there waits again, with more steps, among the settings that are slower.
    """
    search = search_of(other, None, tuning.solver, other.t + tuning.t_end, tuning.search.num_saves)
    waiting, checked = list(rows), []
    for i in range(MAX_CHECKS):
        row = min(waiting, key=attrgetter("seconds"))
        waiting.remove(row)
        tuning.search.progress(f"{row.scheme} from another start", i, MAX_CHECKS)
        family, num_micro, num_steps = tuning.family_of(row), row.num_micro // row.stages, row.num_steps
        trial = search.trial(family, num_micro, num_steps, True, error)
        certified = trial.error if trial.run.num_steps == num_steps else np.inf
        # A search in which nothing moves has errors of exactly 0.
        checked.append((row, Verification(certified, certified / row.error_q if row.error_q else 1.0)))
        if max(certified, row.error_q) <= error:
            warn_of_events("tune", search, trial, stacklevel=5)
            return checked[-1]
        miss = max(certified, row.error_q) / error
        more = MORE_STEPS * miss ** (1 / row.order) if np.isfinite(miss) else trial.run.num_steps / num_steps
        again = tuning.search.trial(family, num_micro, int(np.ceil(more * num_steps)), True, error)
        waiting += [row for row in tuning.rows() if row.settings == tuning.search.settings(again)]
    warnings.warn(
        f"tune: none of {MAX_CHECKS} settings keeps the error {error:g} from another start; the best of them is "
        "recommended.",
        stacklevel=4,
    )
    return min(checked, key=lambda pair: pair[1].error_q)

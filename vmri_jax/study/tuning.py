"""Advice: the scheme, num_micro and macro step that reach an accepted error in the least time, from the search for an accuracy over a whole menu.

Settings are checked by runs from another start, the fastest first, and the first one that keeps the error there too is recommended: at one start
an error may be small by chance, as where its leading term changes sign.
"""

import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from operator import attrgetter
from typing import Any

import jax
import numpy as np

from vmri_jax.accuracy.families import Family, by_promise, families, for_system
from vmri_jax.accuracy.search import Trial
from vmri_jax.accuracy.steps import check_error, digits_of, reached, search_of, warn_of_events
from vmri_jax.mechanics.projection import legendre, project_momentum
from vmri_jax.mechanics.state import HasProblem, Problem, State, problem_of
from vmri_jax.running.failures import simulation_error
from vmri_jax.running.progress import Progress, shows_progress, silent
from vmri_jax.running.settings import Settings
from vmri_jax.steppers.solvers import Newton
from vmri_jax.study.table import ResultTable, interruptible
from vmri_jax.study.work import WorkPrecision, WorkRow, work_row

FINALISTS = 4
"""Families whose micro steps and steps are searched for, of those that promise the least time. A larger number searches longer."""
SETTINGS_PRINTED = 5
"""Number of settings, the recommended one included, that a recommendation and `vmri tune` print."""
RELATIVE_VELOCITY_CHANGE = 0.01
"""Standard deviation of the change of velocities over the largest velocity. The motion is another one with the same time scales; a
larger change may lead to a motion of another kind, with another error."""
MORE_STEPS = 1.1
"""Steps of a setting that misses the error from another start, over the steps that its miss predicts; a smaller number needs more checks, a larger
one leads to slower settings."""
MAX_CHECKS = 8
"""Settings that are checked, the fastest first, until one keeps the error from another start; a larger number searches longer in vain."""
by_seconds = attrgetter("row.seconds")


@dataclass(frozen=True)
class Setting:
    """A run of a search: the family of its scheme, its scheme and steps as arguments of `vmri_jax.simulate`, and its row with error and time."""

    family: Family
    settings: Settings
    row: WorkRow

    @property
    def key(self) -> tuple[str, int, int]:
        """Name of the family, num_micro and number of macro steps."""
        return self.family.name, self.num_micro, self.row.num_steps

    @property
    def num_micro(self) -> int:
        """Micro steps per macro step, or per stage of a composition."""
        return self.row.num_micro // self.row.stages

    def command(self, system: str) -> str:
        """The command line that simulates `system` with this setting."""
        return f"{self.settings.command(system)} --out run.npz"


class Tuning:
    """A search over a menu for the errors of a problem, and a `Setting` for each of its runs; arguments as of `tune`."""

    def __init__(
        self,
        problem: Problem,
        t_end: float,
        menu: Sequence[Family] | None = None,
        num_saves: int | None = None,
        solver: Newton | None = None,
        progress: Progress = silent,
    ):
        self.problem, self.t_end, self.solver = problem, t_end, solver
        self.search = search_of(problem, None, solver, problem.t + t_end, num_saves, progress=progress)
        self.search.seen = self._add
        whole = families() if menu is None else menu
        self.menu = for_system(whole, self.search.system, self.search.has_two_rates)
        self._settings: dict[tuple[str, int, int], Setting] = {}

    def _add(self, trial: Trial) -> Setting:
        """Add the setting of a trial; a failed or uncertified run has an error of NaN."""
        run, error = trial.run, trial.error if np.isfinite(trial.error) else np.nan
        label, numbers = trial.family.label(trial.num_micro), (float(run.macro_dt), run.num_steps)
        row = work_row(label, run.system, run.scheme, trial.trajectory, *numbers, error_q=error)
        setting = Setting(trial.family, self.search.settings(trial), row)
        self._settings[setting.key] = setting
        return setting

    def extent(self) -> float:
        """How far the system moves in the first trials, of the first family if there are none yet."""
        if not self.search.extent():
            self.search.first_trials(self.menu[:1], np.inf)
        return self.search.extent()

    def look_for(self, name: str, error: float, exhaustive: bool = False) -> list[Setting]:
        """Search for an error, and return the settings that keep it, the fastest first; `name` begins messages."""
        menu = by_promise(self.menu, digits_of(self.search, error))
        finals = reached(name, self.search, menu, error, finalists=FINALISTS, exhaustive=exhaustive)
        self.search.measure([trial for trial in finals if np.isfinite(trial.error)])
        return self.keeping(error)

    def run(self, family: Family, num_micro: int, num_steps: int, error: float) -> Setting:
        """The setting of a run with at least this number of macro steps, more if its error is not certified otherwise."""
        trial = self.search.trial(family, num_micro, num_steps, True, error)
        self.search.time_for(trial, error)  # measures the seconds of a step if they are not known
        return self._timed(self._add(trial))

    def settings(self) -> list[Setting]:
        """All runs so far, sorted by family, num_micro and number of steps."""
        return [self._timed(setting) for _, setting in sorted(self._settings.items(), key=lambda item: item[0])]

    def keeping(self, error: float) -> list[Setting]:
        """The settings that keep an error and whose time is known, the fastest first."""
        kept = [s for s in self.settings() if s.row.error_q <= error and np.isfinite(s.row.seconds)]
        return sorted(kept, key=by_seconds)

    def runs(self) -> WorkPrecision:
        """The rows of all runs so far."""
        return WorkPrecision(tuple(setting.row for setting in self.settings()), self.t_end)

    def _timed(self, setting: Setting) -> Setting:
        """The setting with the seconds of its steps, by the seconds of a step of its scheme; NaN if they were not measured."""
        each = self.search.seconds.get((setting.family.python, setting.num_micro), np.nan)
        return replace(setting, row=replace(setting.row, seconds=each * setting.row.num_steps))


class NothingReached(ValueError):
    """No setting kept the error; `.runs` has the runs of the search."""

    def __init__(self, message: str, runs: WorkPrecision):
        self.runs = runs
        super().__init__(message)


@dataclass(frozen=True)
class Verification:
    """A run from another start: its error, infinite if it is not certified, and the ratio of the error to the error in the search."""

    error_q: float
    error_ratio: float


@dataclass(frozen=True)
class Recommendation(ResultTable):
    """The cheapest setting for an error, and the search that led to it; prints as a table of the best few settings.

    Its files, `to_csv` and `to_json`, hold all runs of the search.

    scheme, macro_dt, num_steps: arguments for `vmri_jax.simulate`; `setting.settings` has all of them.
    error: the accepted error, in the unit of the positions.
    setting: the recommended scheme and steps with their error and time.
    others: the runners-up, the fastest first.
    verification: the same setting from another start; None if it was not checked.
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
        """The best settings, the recommended one first."""
        return [setting.row for setting in (self.setting, *self.others)[:SETTINGS_PRINTED]]

    @property
    def caption(self) -> str:
        """The recommended setting, and its error from another start."""
        again = f" From another start its error is {self.verification.error_q:.1e}." if self.verification else ""
        return (
            f"For an error of {self.error:g} take the first: its .scheme, .macro_dt and .num_steps.{again} "
            f"All {len(self.rows)} runs are in .runs and .to_csv(path)."
        )

    def content(self) -> dict[str, Any]:
        """The content of the JSON file: the runs of the search, the accepted error and the recommended run."""
        return {**self.runs.content(), "error": self.error, "choice": asdict(self.setting.row)}

    @property
    def scheme(self):
        """The scheme or composition."""
        return self.setting.settings.scheme

    @property
    def macro_dt(self) -> float:
        """Macro step H."""
        return self.setting.row.macro_dt

    @property
    def num_steps(self) -> int:
        """Macro steps up to t_end."""
        return self.setting.row.num_steps


def check_target(error: float, t_end: float, problem: Problem) -> None:
    """Refuse errors and times that no run can meet."""
    if not (np.isfinite(t_end) and t_end > 0):
        raise ValueError(f"tune: t_end is {t_end}; it must be a positive number.")
    check_error("tune: error", error, problem)


@shows_progress
def tune(
    problem: Problem | HasProblem,
    error: float,
    t_end: float,
    *,
    menu: Sequence[Family] | None = None,
    num_saves: int | None = None,
    solver: Newton | None = None,
    verify: bool = True,
    exhaustive: bool = False,
    progress: Any = False,
) -> Recommendation:
    """Find the scheme, num_micro and macro step that reach an error in the least time on this machine.

    Errors are those of ``simulate(..., error=True)``: estimated by companion runs, the largest over all positions and saved nodes, and certified.

    Args:
        problem: system and start; a `Problem` or a scene.
        error: largest accepted error of a position, in the unit of the positions, from this start and from another one.
        t_end: simulated time.
        menu: families to choose from, by default `families()`.
        num_saves: saved intervals, equally spaced, at whose ends errors are compared; None for one per macro step, at most 1000.
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
    search = tuning.search
    search.fewest = True
    with interruptible(tuning.runs):
        settings = tuning.look_for("tune: error", error, exhaustive)
        if not settings:
            raise _nothing(tuning, error)
        setting, verification = settings[0], None
        if verify:
            mean_speed = search.extent() / t_end
            setting, verification = first_verified(tuning, settings, error, another_start(problem, mean_speed))
    progress("done", 1, 1)
    others = tuple(s for s in tuning.keeping(error) if s.key != setting.key)
    return Recommendation(error, setting, others, verification, tuning.runs())


def _nothing(tuning: Tuning, error: float) -> Exception:
    """The reason why no setting keeps the error: all runs failed, or none is as accurate."""
    search, settings = tuning.search, tuning.settings()
    trial = search.first_trials(tuning.menu, error)[0]
    if all(setting.row.result not in ("CONVERGED", "CONVERGED_AT_ROUNDOFF") for setting in settings):
        run = trial.run
        return simulation_error(trial.trajectory, run.macro_dt, run.save_every, run.scheme.num_micro)
    best = min(settings, key=lambda s: np.nan_to_num(s.row.error_q, nan=np.inf))
    certified = f"the best error was {best.row.error_q:.1e}, with {best.row.scheme} and {best.row.num_steps} steps"
    reason = certified if np.isfinite(best.row.error_q) else "no error is certified until t_end"
    text = (
        f"tune: no setting reached {error:g} in {len(settings)} runs; {reason}. Give a larger error or a shorter t_end."
    )
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


def first_verified(
    tuning: Tuning, settings: Sequence[Setting], error: float, other: Problem
) -> tuple[Setting, Verification]:
    """The fastest setting whose run from another start, too, keeps the error; warns if none of `MAX_CHECKS` settings does.

    A setting that misses the error there waits again, with more steps, among the settings that are slower.
    """
    search = search_of(other, None, tuning.solver, other.t + tuning.t_end, tuning.search.num_saves)
    waiting, checked = list(settings), []
    for i in range(MAX_CHECKS):
        setting = min(waiting, key=by_seconds)
        waiting.remove(setting)
        tuning.search.progress(f"{setting.row.scheme} from another start", i, MAX_CHECKS)
        num_steps, of_search = setting.row.num_steps, setting.row.error_q
        trial = search.trial(setting.family, setting.num_micro, num_steps, True, error)
        certified = trial.error if trial.run.num_steps == num_steps else np.inf
        # A search in which nothing moves has errors of exactly 0.
        checked.append((setting, Verification(certified, certified / of_search if of_search else 1.0)))
        if max(certified, of_search) <= error:
            break
        miss = max(certified, of_search) / error
        more = MORE_STEPS * miss ** (1 / setting.row.order) if np.isfinite(miss) else trial.run.num_steps / num_steps
        if np.isfinite(more):
            waiting.append(tuning.run(setting.family, setting.num_micro, int(np.ceil(more * num_steps)), error))
    else:
        warnings.warn(
            f"tune: none of {MAX_CHECKS} settings keeps the error {error:g} from another start; the best of them is recommended.",
            stacklevel=4,
        )
        return min(checked, key=lambda pair: pair[1].error_q)
    warn_of_events("tune", search, trial, stacklevel=5)
    return checked[-1]

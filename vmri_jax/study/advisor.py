"""Advice: the scheme, num_micro and macro step that reach an accepted error in the least time, from the search of `search.py`.

Settings are checked by runs from another start, the fastest first, and the first one that keeps the error there too is recommended: at one start
an error may be small by chance, as where its leading term changes sign.
"""

import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import jax
import numpy as np

from vmri_jax.accuracy.families import Family, families
from vmri_jax.accuracy.steps import check_error
from vmri_jax.mechanics.projection import legendre, project_momentum
from vmri_jax.mechanics.state import HasProblem, Problem, State, problem_of
from vmri_jax.running.progress import shows_progress
from vmri_jax.steppers.results import SimulationError
from vmri_jax.steppers.solver import Solver
from vmri_jax.study.program import Program
from vmri_jax.study.reference_solution import ReferenceSolution, reference_solution
from vmri_jax.study.search import TIMED_RUNS, Search, Setting, by_seconds
from vmri_jax.study.table import ResultTable, interruptible
from vmri_jax.study.work import WorkPrecision, WorkRow, duration, work_row

MIN_ERROR_OVER_REFERENCE = 10.0
"""Least ratio of the accepted error to the error of the reference; at a smaller ratio the error of the reference decides which
runs keep the accepted error, a larger one refuses searches that would succeed."""
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


class NothingReached(ValueError):
    """No setting kept the error; `.runs` has the runs of the search."""

    def __init__(self, message: str, runs: WorkPrecision):
        self.runs = runs
        super().__init__(message)


@dataclass(frozen=True)
class Verification:
    """A run from another start: its error and time, and the ratio of the error to the error in the search."""

    error_q: float
    seconds: float
    error_ratio: float


@dataclass(frozen=True)
class Recommendation(ResultTable):
    """The cheapest setting for an error, and the search that led to it; prints as a table of the best few settings.

    Its files, `to_csv` and `to_json`, hold all runs of the search.

    scheme, macro_dt, num_steps: arguments for `vmri_jax.simulate`.
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
        check = self.verification
        again = f" From another start its error is {check.error_q:.1e}, in {duration(check.seconds)}." if check else ""
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
        return self.setting.scheme

    @property
    def macro_dt(self) -> float:
        """Macro step H."""
        return self.setting.row.macro_dt

    @property
    def num_steps(self) -> int:
        """Macro steps up to t_end."""
        return self.setting.num_steps


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
    num_saves: int = 10,
    reference: ReferenceSolution | None = None,
    solver: Solver | None = None,
    verify: bool = True,
    exhaustive: bool = False,
    progress: Any = False,
) -> Recommendation:
    """Find the scheme, num_micro and macro step that reach an error in the least time on this machine.

    Args:
        problem: system and start; a `Problem` or a scene.
        error: largest accepted ``|q - q_ref|`` over the compared nodes, in the unit of the positions, from this start and from another one.
        t_end: simulated time.
        menu: families to choose from, by default `families()`.
        num_saves: nodes compared, equally spaced, the last one at t_end.
        reference: the solution that errors are measured against; by default `reference_solution`.
        solver: how implicit equations are solved.
        verify: run settings from another start, too, and recommend one that keeps the error there.
        exhaustive: try every num_micro of every family, to check the staged search.
        progress: True for a bar, or a function (what, done, total) that is told about every attempt.

    Raises:
        ValueError: an error below round-off, or too near the error of the reference.
        NothingReached: no setting keeps the error; carries the runs.
        SimulationError: the reference could not be computed.
        Interrupted: Ctrl-C during the search; carries the runs.

    Warns:
        UserWarning: the recommended setting could not be checked from another start, or none keeps the error there.
    """
    problem = problem_of("tune", problem)
    check_target(error, t_end, problem)
    if reference is None:
        reference = reference_solution(problem, t_end, num_saves=num_saves, progress=progress)
    least = MIN_ERROR_OVER_REFERENCE * reference.error_q
    if error < least:
        raise ValueError(
            f"tune: error is {error:g}, but the reference solution is only good to {reference.error_q:.1e}: its error no "
            f"longer falls with the step, as where the motion is chaotic. Give a smaller t_end, an error of at least "
            f"{least:.1e}, or a better reference."
        )
    # Schemes that need the fallback of Newton's method are seldom the cheapest, and the fallback takes long to compile:
    # the first search does without.
    for fallback in (False, True):
        search = Search(problem, t_end, families() if menu is None else menu, reference, solver, fallback)
        with interruptible(search.rows):
            settings = search.cheapest(error, progress, exhaustive)
        if settings:
            break
    else:
        best = min(search.settings.values(), key=lambda s: np.nan_to_num(s.row.error_q, nan=np.inf))
        raise NothingReached(
            f"tune: no setting reached {error:g} in {len(search.settings)} runs; the best error was "
            f"{best.row.error_q:.1e}, with {best.row.scheme} and {best.num_steps} steps. Give a larger error.",
            search.rows(),
        )
    setting, verification = settings[0], None
    if verify:
        progress("another start", 1, 1)
        mean_speed = float(np.abs(reference.q - reference.q[0]).max()) / t_end
        try:
            with interruptible(search.rows):
                other = another_start(problem, mean_speed)
                other_reference = reference_solution(other, t_end, num_saves=reference.num_saves)
                setting, verification = first_verified(search, settings, error, other, other_reference)
        except SimulationError as failure:
            warnings.warn(
                f"tune: the setting is not checked from another start, because the reference solution fails there: {failure}",
                stacklevel=2,
            )
    progress("done", 1, 1)
    runners_up = tuple(s for s in settings if s is not setting)
    return Recommendation(error, setting, runners_up, verification, search.rows())


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
    search: Search, settings: Sequence[Setting], error: float, problem: Problem, reference: ReferenceSolution
) -> tuple[Setting, Verification]:
    """The fastest setting whose run from another start, too, keeps the error; warns if none of `MAX_CHECKS` settings does.

    A setting that misses the error there waits again, with more steps, among the settings that are slower.
    """
    waiting, checked = list(settings), []
    for _ in range(MAX_CHECKS):
        setting = min(waiting, key=by_seconds)
        waiting.remove(setting)
        program = Program(problem, setting.scheme, search.t_end, reference.num_saves, search.solver)
        row = work_row(setting.row.scheme, program, setting.num_steps, reference)
        # a search in which nothing moves has errors of exactly 0
        error_ratio = row.error_q / setting.row.error_q if setting.row.error_q else 1.0
        seconds = program.seconds(setting.num_steps, TIMED_RUNS) if np.isfinite(row.error_q) else [np.nan]
        checked.append((setting, Verification(row.error_q, row.timed(seconds).seconds, error_ratio)))
        if row.error_q <= error and setting.row.error_q <= error:
            return checked[-1]
        miss = max(row.error_q, setting.row.error_q) / error
        more = MORE_STEPS * miss ** (1 / row.order) if np.isfinite(miss) else 2.0  # a failed run (NaN) tells no error
        unit = reference.num_saves
        waiting.append(
            search.run(setting.family, setting.num_micro, unit * int(np.ceil(more * setting.num_steps / unit)))
        )
    warnings.warn(
        f"tune: none of {MAX_CHECKS} settings keeps the error {error:g} from another start; the best of them is recommended.",
        stacklevel=3,
    )
    return min(checked, key=lambda pair: np.nan_to_num(pair[1].error_q, nan=np.inf))

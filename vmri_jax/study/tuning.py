"""Advice: the scheme, num_micro and macro step that reach an accepted error in the least time, from the search for an
accuracy over a whole menu."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any

import numpy as np

from vmri_jax.accuracy.families import Family, Trial, by_promise, families, for_system
from vmri_jax.accuracy.search import Search
from vmri_jax.mechanics.state import HasProblem, Problem, problem_of
from vmri_jax.running.failures import simulation_error
from vmri_jax.running.progress import shows_progress
from vmri_jax.steppers.solver import Solver
from vmri_jax.study.row import Row, WorkPrecision, row_of
from vmri_jax.study.table import interruptible

FINALISTS = 4
"""Families whose micro steps and steps are searched for, of those that promise the least time; more take longer."""
SETTINGS_PRINTED = 5
"""Number of settings, the recommended one included, that a recommendation and `vmri tune` print."""


class Tuning(Search):
    """A search over a menu, with a row for each of its runs; arguments as of `tune`."""

    def __init__(self, name: str, problem: Problem, t_end: float, menu: Sequence[Family] | None = None, **how: Any):
        super().__init__(problem, problem.t + t_end, name=name, **how)
        self.menu = for_system(families() if menu is None else menu, self.system, self.has_two_rates)
        self._rows: dict[tuple[str, int], Row] = {}

    def note(self, trial: Trial) -> None:
        """Add the row of a trial; a failed or uncertified run has an error of NaN."""
        run, error = trial.run, trial.error if np.isfinite(trial.error) else np.nan
        label, numbers = trial.family.label(trial.num_micro), (float(run.macro_dt), run.num_steps)
        measured = {"error_q": error, "settings": self.settings(trial), "family": trial.family.name}
        row = row_of(label, run.system, run.scheme, trial.trajectory, *numbers, **measured)
        self._rows[trial.python, run.num_steps] = row

    def look_for(self, error: float, exhaustive: bool = False) -> WorkPrecision:
        """Search for an error, and return the table of all runs so far."""
        finals = self.cheapest(by_promise(self.menu, self.digits(error)), error, FINALISTS, exhaustive)
        self.measure([trial for trial in finals if np.isfinite(trial.error)])
        return self.runs()

    def runs(self) -> WorkPrecision:
        """The table of all runs so far, sorted by scheme and number of steps, with the seconds of the steps."""
        rows = sorted(self._rows.values(), key=attrgetter("scheme", "num_steps"))
        seconds = [self.seconds.get(row.settings.python, np.nan) * row.num_steps for row in rows]
        return WorkPrecision(tuple(replace(row, seconds=s) for row, s in zip(rows, seconds, strict=True)))


class NothingReached(ValueError):
    """No setting kept the error; `.runs` has the runs of the search."""

    def __init__(self, message: str, runs: WorkPrecision):
        self.runs = runs
        super().__init__(message)


@dataclass(frozen=True, repr=False)
class Recommendation(WorkPrecision):
    """The cheapest setting for an error, and all runs of the search that led to it; prints as a table of the best few settings.

    error: the accepted error, in the unit of the positions.
    """

    error: float = 0.0

    @property
    def setting(self) -> Row:
        """The recommended run, with its error and time; `setting.settings.arguments` are all arguments for `vmri_jax.simulate`."""
        return self.keeping(self.error)[0]

    @property
    def runs(self) -> WorkPrecision:
        """The runs by their errors and their work; prints as their Pareto front."""
        return WorkPrecision(self.rows)

    def shown(self) -> list[Row]:
        """The best settings, the recommended one first."""
        return self.keeping(self.error)[:SETTINGS_PRINTED]

    @property
    def caption(self) -> str:
        """The recommended setting."""
        first = f"For an error of {self.error:g} take the first: its .scheme, .macro_dt and .num_steps"
        return f"{first}. All {len(self.rows)} runs are in .runs and .to_csv(path)."

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


@shows_progress
def tune(
    problem: Problem | HasProblem,
    error: float,
    t_end: float,
    *,
    menu: Sequence[Family] | None = None,
    num_saves: int | None = None,
    solver: Solver | None = None,
    exhaustive: bool = False,
    progress: Any = False,
) -> Recommendation:
    """Find the scheme, num_micro and macro step that reach an error in the least time on this machine.

    The search is that of ``simulate(..., accuracy=)`` over the whole menu in place of two families. Errors are those of
    ``simulate(..., error=True)``: estimated by companion runs, the largest over all positions and saved nodes, and
    certified. They belong to this start: run the choice from another start with ``error=True`` to know its error there.

    Args:
        problem: system and start; a `Problem` or a scene.
        error: largest accepted error of a position, in the unit of the positions.
        t_end: simulated time.
        menu: families to choose from, by default `families()`.
        num_saves: equal intervals at whose ends errors are compared; None for one per macro step, at most 1000.
        solver: how implicit equations are solved.
        exhaustive: try every num_micro of every family, to check the staged search.
        progress: True for a bar, or a function (what, done, total) that is told about every trial run.

    Raises:
        ValueError: an error below round-off, or above the extent of the motion.
        NothingReached: no setting keeps the error; carries the runs.
        SimulationError: the runs of all families fail.
        Interrupted: Ctrl-C during the search; carries the runs.

    Warns:
        UserWarning: events of forces demand many steps.
    """
    problem = problem_of("tune", problem)
    tuning = Tuning("tune: error", problem, t_end, menu, num_saves=num_saves, solver=solver, progress=progress)
    tuning.check(error)
    with interruptible(tuning.runs):
        choice = Recommendation(tuning.look_for(error, exhaustive).rows, error=error)
        if not choice.keeping(error):
            raise _nothing(tuning, error)
    progress("done", 1, 1)
    tuning.warn_of_events("tune", choice.scheme, stacklevel=4)
    return choice


def _nothing(tuning: Tuning, error: float) -> Exception:
    """The reason why no setting keeps the error: all runs failed, or none is as accurate."""
    runs, trial = tuning.runs(), tuning.first_trials(tuning.menu, error)[0]
    if all(row.result not in ("CONVERGED", "CONVERGED_AT_ROUNDOFF") for row in runs.rows):
        return simulation_error(trial.trajectory, trial.run.macro_dt, trial.run.save_every, trial.run.scheme.num_micro)
    best = min(runs.rows, key=lambda row: np.nan_to_num(row.error_q, nan=np.inf))
    certified = f"the best error was {best.error_q:.1e}, with {best.scheme} and {best.num_steps} steps"
    reason = certified if np.isfinite(best.error_q) else "no error is certified until t_end"
    text = f"tune: no setting reached {error:g} in {len(runs.rows)} runs; {reason}. Give a larger error or a shorter t_end."
    return NothingReached(text, runs)

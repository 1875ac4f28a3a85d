"""Advice from the search for an accuracy over a whole menu: the scheme, num_micro and macro step that reach an accepted
error in the least time; and a page on the cost of accuracy, what one search for a few errors has seen."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax import plots
from vmri_jax.accuracy.companions import Trial
from vmri_jax.accuracy.families import Family, by_promise, families, for_system
from vmri_jax.accuracy.search import Search
from vmri_jax.mechanics.arrays import split_at
from vmri_jax.mechanics.linearisation import linearise
from vmri_jax.mechanics.state import HasProblem, Problem, problem_of
from vmri_jax.mechanics.terms import Term
from vmri_jax.refusals import Refused
from vmri_jax.running.failures import simulation_error
from vmri_jax.running.files import make_writable_folder
from vmri_jax.running.progress import part, progress_to
from vmri_jax.running.timing import seconds_each
from vmri_jax.steppers.solver import Solver
from vmri_jax.study.html import embedded, write_page
from vmri_jax.study.row import Row, WorkPrecision, duration, record, row_of
from vmri_jax.study.table import Column, ResultTable, interruptible

FINALISTS = 4
"""Families whose micro steps and steps are searched for, of those that promise the least time; more take longer."""
SETTINGS_PRINTED = 5
"""Number of settings, the recommended one included, that a recommendation and `vmri tune` print."""
TEMPLATE = Path(__file__).parent / "cost.html.j2"
PERIODS = 30
"""Default t_end in periods of the fastest vibration; a larger number shows slower effects and takes longer."""
RELATIVE_ERRORS = (1e-2, 1e-4, 1e-6, 1e-8)
"""Default errors, relative to how far the system moves; further entries take longer."""


class Tuning(Search):
    """A search over a menu, with a row for each of its runs; arguments as of `tune`."""

    def __init__(self, name: str, problem: Problem, t_end: float, menu: Sequence[Family] | None = None, **how: Any):
        super().__init__(problem, problem.t + t_end, name=name, **how)
        self.menu = for_system(families() if menu is None else menu, self.system, self.has_two_rates)
        self._rows: dict[tuple[str, int], Row] = {}

    def note(self, trial: Trial) -> None:
        """Add the row of a trial; a failed or uncertified run has an error of NaN."""
        run, error = trial.run, trial.error if np.isfinite(trial.error) else np.nan
        label, numbers = trial.family.label(trial.family.first), (float(run.macro_dt), run.num_steps)
        measured = {"error_q": error, "settings": self.settings(trial), "family": trial.family.name}
        row = row_of(label, run.system, run.scheme, trial.trajectory, *numbers, **measured)
        self._rows[trial.family.expression, run.num_steps] = row

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
    """The cheapest setting for an error, and all runs of the search that led to it; prints as a table of the best few
    settings.

    error: the accepted error, in the unit of the positions.
    """

    error: float = 0.0

    @property
    def setting(self) -> Row:
        """The recommended run, with its error and time; `setting.settings.arguments` are all arguments for
        `vmri_jax.simulate`. None, in a report on several errors, where no run keeps the error."""
        return next(iter(self.keeping(self.error)), None)  # pyright: ignore[reportReturnType] `tune` raises then

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
    with progress_to("tune", progress) as tell:
        problem = problem_of("tune", problem)
        tuning = Tuning("tune: error", problem, t_end, menu, num_saves=num_saves, solver=solver, progress=tell)
        tuning.check(error)
        with interruptible(tuning.runs):
            choice = Recommendation(tuning.look_for(error, exhaustive).rows, error=error)
            if choice.setting is None:
                raise _nothing(tuning, error)
        tell("done", 1, 1)
        tuning.warn_of_events("tune", choice.scheme)
        return choice


def _nothing(tuning: Tuning, error: float) -> Exception:
    """The reason why no setting keeps the error: all runs failed, or none is as accurate."""
    runs, trial = tuning.runs(), tuning.first_trials(tuning.menu, error)[0]
    if all(row.result not in ("CONVERGED", "CONVERGED_AT_ROUNDOFF") for row in runs.rows):
        return simulation_error(trial.run, trial.trajectory)
    best = min(runs.rows, key=lambda row: np.nan_to_num(row.error_q, nan=np.inf))
    certified = f"the best error was {best.error_q:.1e}, with {best.scheme} and {best.num_steps} steps"
    reason = certified if np.isfinite(best.error_q) else "no error is certified until t_end"
    text = (
        f"tune: no setting reached {error:g} in {len(runs.rows)} runs; {reason}. Give a larger error or a shorter "
        "t_end."
    )
    return NothingReached(text, runs)


def _of_setting(form: Callable[[Row], str]) -> Callable[[Recommendation], str]:
    """The text of a column: `form` of the run, empty if none keeps the error."""
    return lambda answer: "" if answer.setting is None else form(answer.setting)


@dataclass(frozen=True, repr=False)
class CostReport(ResultTable):
    """The answers of a search for several errors, and the path of their page; its table has a line per answer.

    path: of the page, cost.html; its figures and runs lie beside it.
    name: of the system.
    t_end: simulated time.
    errors: accepted errors of a position.
    runs: every run of the search.
    bound: seconds and error of the Pareto front, if runs took the time of their gradients; empty with constraints.
    """

    columns = (
        Column("error", lambda answer: f"{answer.error:.0e}", right=True),
        Column("scheme", lambda answer: "not reached" if answer.setting is None else answer.setting.scheme),
        Column("macro step", _of_setting(lambda row: f"{row.macro_dt:.4g}"), right=True),
        Column("reached", _of_setting(lambda row: f"{row.error_q:.1e}"), right=True),
        Column("time", _of_setting(lambda row: duration(row.seconds)), right=True),
    )
    path: Path
    name: str
    t_end: float
    errors: tuple[float, ...]
    runs: WorkPrecision
    bound: tuple[tuple[float, float], ...] = ()

    @property
    def rows(self) -> list[Recommendation]:
        """The answers by error, the largest first: the fastest run that keeps the error, for whichever error the search
        made it."""
        return [Recommendation(self.runs.rows, error=error) for error in sorted(self.errors, reverse=True)]

    @property
    def caption(self) -> str:
        """The simulated time, and what the errors are."""
        return f"Runs to t = {self.t_end:g}, with the largest errors of the positions on the way."

    @property
    def curves(self) -> WorkPrecision:
        """The Pareto fronts of the families, each with the name of the family as its scheme."""
        fronts: list[Row] = []
        for family in dict.fromkeys(row.family for row in self.runs.rows):
            of_family = [replace(row, scheme=family) for row in self.runs.rows if row.family == family]
            fronts += WorkPrecision(tuple(of_family)).pareto()
        return WorkPrecision(tuple(fronts))

    @property
    def reached(self) -> list[Row]:
        """The runs of the answers that have one."""
        return [answer.setting for answer in self.rows if answer.setting is not None]

    def records(self) -> list[dict[str, Any]]:
        """A dictionary for each answer: the error and the columns of its run."""
        return [{"error": a.error, **(record(a.setting) if a.setting else {})} for a in self.rows]

    def figure(self, title: str, theme: plots.Theme) -> plots.NotebookFigure:
        """Error against time: a curve for each family, the answers, and the bound."""
        return plots.plot_work_precision(self.curves, title, theme=theme, ringed=self.reached, bound=self.bound)


def default_t_end(problem: Problem) -> float:
    """PERIODS periods of the fastest vibration, rounded to one digit; 1 if nothing vibrates."""
    frequency = float(linearise(problem).frequencies.max(initial=0.0))
    if not frequency > 0:
        return 1.0
    return float(f"{PERIODS * 2 * math.pi / frequency:.0e}")


def cost_report(
    problem: Problem | HasProblem,
    name: str,
    out: str | Path,
    *,
    t_end: float | None = None,
    errors: Sequence[float] | None = None,
    menu: Sequence[Family] | None = None,
    progress: Any = False,
) -> CostReport:
    """Search for the cheapest settings for a few errors and write ``cost.html``, ``cost.png`` and ``cost.csv``.

    A search that ends early, by Ctrl-C or by a failure, leaves the page of the errors that it has answered.

    Args:
        problem: system and start; a `Problem` or a scene.
        name: of the system, for the title and the commands: a built-in one or ``my_file.py:my_problem``.
        out: folder, made if it does not exist.
        t_end: simulated time, by default `default_t_end`.
        errors: largest accepted errors of a position, as of `tune`; by default `RELATIVE_ERRORS` of the motion.
        menu: families to choose from, by default `families()`.
        progress: True for a bar, or a function (what, done, total) that is told about every run.

    Raises:
        ValueError: errors below round-off, or above the extent of the motion; no errors, and no motion.
        Interrupted: Ctrl-C; carries the runs of the search.
    """
    with progress_to("cost_report", progress) as tell:
        problem, out = problem_of("cost_report", problem), Path(out)
        make_writable_folder(out)
        t_end = default_t_end(problem) if t_end is None else t_end
        tuning, answered = Tuning("cost_report: each of errors", problem, t_end, menu, progress=tell), []
        for error in errors or ():
            tuning.check(error)
        with interruptible(tuning.runs):  # around the drawing as well, so that Ctrl-C there keeps the runs, too
            tuning.first_trials(tuning.menu[:1], np.inf)  # they tell how far the system moves
            errors = sorted(errors or _default_errors(tuning))
            tuning.check_extent(errors[-1])
            try:
                # The smallest error first: families that are given up for it are hopeless for larger errors.
                for i, error in enumerate(errors):
                    tuning.progress = part(tell, i, len(errors))
                    tuning.look_for(error)
                    answered.append(error)
            finally:
                report = CostReport(out / "cost.html", name, t_end, tuple(answered), tuning.runs())
                # Constraints cost more than their evaluations: the runs have no bound.
                if report.reached and not problem.system.is_constrained:
                    report = replace(report, bound=bound_of(prices(problem), report.curves.pareto()))
                if answered:
                    _write(report, problem)
        tell("done", 1, 1)
        return report


def prices(problem: Problem) -> dict[str | int, float]:
    """Seconds of one evaluation of the gradient of each potential that the system has, by the name of the potential,
    each timed in a compiled loop of its own."""
    system, n_s = problem.system, problem.q_s.size

    def gradient(term: Term) -> Callable:
        return jax.grad(lambda q: term.at(split_at(q, n_s), system.params))

    q = jnp.concatenate([jnp.asarray(problem.q_s), jnp.asarray(problem.q_f)])
    return {term.name: seconds_each(gradient(term), q) for term in system.of_kind("potential")}


def bound_of(price: Mapping[str | int, float], rows: Sequence[Row]) -> tuple[tuple[float, float], ...]:
    """Seconds and error of runs that take the time of their gradients alone, evaluations times `prices`.

    A gradient in a loop of its own may take longer than in the run, so that the time of the run bounds it.
    """
    counts = [{"V": row.slow_evaluations, "W": row.fast_evaluations, **row.evaluations} for row in rows]
    seconds = [sum(each * count.get(name, 0) for name, each in price.items()) for count in counts]
    return tuple((min(time, row.seconds), row.error_q) for time, row in zip(seconds, rows, strict=True))


def _default_errors(tuning: Tuning) -> list[float]:
    """RELATIVE_ERRORS of a power of ten near how far the system moves, without errors that round-off hides."""
    moved, least = tuning.extent(), tuning.round_off
    motion = 10.0 ** math.floor(math.log10(moved)) if moved > 0 else 0.0
    errors = [motion * error for error in RELATIVE_ERRORS if motion * error > least]
    if not errors:
        rest = (
            f"until t_end = {tuning.length:g} positions move by {moved:.1e}, and errors below {least:.1e} are round-off"
        )
        reason = "the system is at rest, or no run until then is certified"
        raise Refused(f"cost_report: {rest}: {reason}. Give a start that moves, another t_end, or the errors.")
    return errors


def _write(report: CostReport, problem: Problem) -> None:
    """The runs, the figures and the page of a report."""
    report.runs.to_csv(report.path.parent / "cost.csv")
    rows = sum(problem.system.num_constraints(problem.q_s, problem.q_f))
    sizes = {"slow variables": problem.q_s.size, "fast variables": problem.q_f.size, "constraints": rows}
    title = f"{report.name}: what accuracy costs over a time of {report.t_end:g}"
    try:
        for end, theme in (("", plots.LIGHT), ("_dark", plots.DARK)):
            plots.save(report.figure(title, theme), report.path.parent / f"cost{end}.png", theme)
        figure = embedded(partial(report.figure, ""))
        write_page(report.path, TEMPLATE, report=report, sizes=sizes, duration=duration, figure=figure)
    except Exception as fault:
        fault.add_note(f"{report.path} could not be drawn or written; all runs are in cost.csv beside it.")
        raise

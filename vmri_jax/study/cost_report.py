"""A page on the cost of accuracy for a system: what one search for a few errors has seen."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax import plots
from vmri_jax.accuracy.families import Family
from vmri_jax.mechanics.linearisation import linearise
from vmri_jax.mechanics.state import HasProblem, Problem, problem_of
from vmri_jax.mechanics.terms import Term
from vmri_jax.refusals import Refused
from vmri_jax.running.files import make_writable_folder
from vmri_jax.running.progress import part, shows_progress
from vmri_jax.running.timing import seconds_each
from vmri_jax.study.html import embedded, write_page
from vmri_jax.study.row import Row, WorkPrecision, duration, record
from vmri_jax.study.table import Column, ResultTable, interruptible
from vmri_jax.study.tuning import Tuning

TEMPLATE = Path(__file__).parent / "cost.html.j2"
PERIODS = 30
"""Default t_end in periods of the fastest vibration; a larger number shows slower effects and takes longer."""
RELATIVE_ERRORS = (1e-2, 1e-4, 1e-6, 1e-8)
"""Default errors, relative to how far the system moves; further entries take longer."""


@dataclass(frozen=True)
class Answer:
    """The largest accepted error of the positions, and the run of the cheapest setting; None if no setting keeps it."""

    error: float
    setting: Row | None


def _of_setting(form: Callable[[Row], str]) -> Callable[[Answer], str]:
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
    def rows(self) -> list[Answer]:
        """The answers by error, the largest first: the fastest run that keeps the error, for whichever error the search made it."""
        errors = sorted(self.errors, reverse=True)
        return [Answer(error, next(iter(self.runs.keeping(error)), None)) for error in errors]

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


@shows_progress
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
    problem, out = problem_of("cost_report", problem), Path(out)
    make_writable_folder(out)
    t_end = default_t_end(problem) if t_end is None else t_end
    tuning, answered = Tuning("cost_report: each of errors", problem, t_end, menu, progress=progress), []
    for error in errors or ():
        tuning.check(error)
    with interruptible(tuning.runs):  # around the drawing as well, so that Ctrl-C there keeps the runs, too
        tuning.first_trials(tuning.menu[:1], np.inf)  # they tell how far the system moves
        errors = sorted(errors or _default_errors(tuning))
        tuning.check_extent(errors[-1])
        try:
            # The smallest error first: families that are given up for it are hopeless for larger errors.
            for i, error in enumerate(errors):
                tuning.progress = part(progress, i, len(errors))
                tuning.look_for(error)
                answered.append(error)
        finally:
            report = CostReport(out / "cost.html", name, t_end, tuple(answered), tuning.runs())
            # Constraints cost more than their evaluations: the runs have no bound.
            if report.reached and not problem.system.is_constrained:
                report = replace(report, bound=bound_of(prices(problem), report.curves.pareto()))
            if answered:
                _write(report, problem)
    progress("done", 1, 1)
    return report


def prices(problem: Problem) -> dict[str | int, float]:
    """Seconds of one evaluation of the gradient of each potential that the system has, by the name of the potential,
    each timed in a compiled loop of its own."""
    system, n_s = problem.system, problem.q_s.size

    def gradient(term: Term) -> Callable:
        return jax.grad(lambda q: term(system.params, q_s=q[:n_s], q_f=q[n_s:]))

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

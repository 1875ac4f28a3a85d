"""A page on the cost of accuracy for a system: the cheapest scheme for each of a few errors, and where the time goes."""

import math
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vmri_jax import diagnostics, plots
from vmri_jax.accuracy.families import Family, families
from vmri_jax.accuracy.steps import round_off, with_accuracy
from vmri_jax.mechanics.state import HasProblem, Problem, problem_of
from vmri_jax.running.files import make_writable_folder
from vmri_jax.running.progress import part, shows_progress
from vmri_jax.steppers.results import SimulationError
from vmri_jax.study.advisor import MIN_ERROR_OVER_REFERENCE
from vmri_jax.study.html import embedded, write_page
from vmri_jax.study.prices import FAST, SLOW, draw_shares, prices, shares
from vmri_jax.study.program import Program
from vmri_jax.study.reference_solution import ReferenceSolution, reference_solution
from vmri_jax.study.search import Search, Setting, stopwatch
from vmri_jax.study.staircase import MICRO, SINGLE, Stair, confirm, confirmed, staircases, with_shares
from vmri_jax.study.table import Column, ResultTable, interruptible
from vmri_jax.study.work import WorkPrecision, WorkRow, duration, work_row

TEMPLATE = Path(__file__).parent / "cost.html.j2"
PERIODS = 30
"""Default t_end in periods of the fastest vibration; a larger number shows slower effects and takes longer."""
RELATIVE_ERRORS = (1e-2, 1e-4, 1e-6, 1e-8)
"""Default errors, relative to how far the system moves; further entries take longer."""
BUDGET = 75.0
"""Seconds of search, see `stopwatch`, after which no more schemes are compiled; a larger value tries more schemes. Each error may take
half of the time that is left, since schemes compiled for one error serve the next ones."""
REPEATS = 5
"""Samples of the time of the run that `accuracy=` chooses; more samples make their median surer."""


@dataclass(frozen=True)
class Answer:
    """The largest accepted error of the positions, and the cheapest setting for it; None if no setting keeps the error."""

    error: float
    setting: Setting | None


class PageFailed(RuntimeError):
    """The search came to its end, but its page could not be drawn or written; its results are in `.report` and in cost.csv."""

    def __init__(self, report: "CostReport"):
        self.report = report
        super().__init__(
            f"{report.path} could not be drawn or written; all runs are in {report.path.with_name('cost.csv')}."
        )


def _of_setting(form: Callable[[WorkRow], str]) -> Callable[[Answer], str]:
    """The text of a column: `form` of the run of the setting, empty if no setting keeps the error."""
    return lambda answer: "" if answer.setting is None else form(answer.setting.row)


@dataclass(frozen=True)
class CostReport(ResultTable):
    """The answers of a search for several errors, and the path of their page; its table has a line per answer.

    path: of the page, cost.html; its figures and runs lie beside it.
    name: of the system.
    t_end: simulated time.
    rows: the answers by error, the largest first.
    runs: every run of the search.
    shares: parts of the time of the middle answer by function, see `vmri_jax.study.prices.shares`.
    not_tried: families that the search had no time to compile.
    stairs: the staircase of each kind of schemes, see `vmri_jax.study.staircase`.
    accuracy: the run that ``simulate(..., accuracy=accuracy_error)`` takes; None where it refuses the error or fails.
    accuracy_error: the middle one of the errors.
    """

    columns = (
        Column("error", lambda answer: f"{answer.error:.0e}", right=True),
        Column("scheme", lambda answer: "not reached" if answer.setting is None else answer.setting.row.scheme),
        Column("macro step", _of_setting(lambda row: f"{row.macro_dt:.4g}"), right=True),
        Column("reached", _of_setting(lambda row: f"{row.error_q:.1e}"), right=True),
        Column("time", _of_setting(lambda row: duration(row.seconds)), right=True),
    )
    path: Path
    name: str
    t_end: float
    rows: tuple[Answer, ...]
    runs: WorkPrecision
    shares: dict[str, float]
    not_tried: tuple[str, ...] = ()
    stairs: dict[str, list[Stair]] = field(default_factory=dict)
    accuracy: WorkRow | None = None
    accuracy_error: float = math.nan

    @property
    def caption(self) -> str:
        """The simulated time, the smallest error that the reference solution can tell, and the schemes that were not tried."""
        sentences = [f"Runs to t = {self.t_end:g}, with the largest errors of the positions on the way."]
        known_to = self.runs.reference.error_q
        if known_to:
            least = MIN_ERROR_OVER_REFERENCE * known_to
            sentences.append(
                f"The reference solution is good to {known_to:.0e}: errors below {least:.0e} cannot be told."
            )
        return " ".join(filter(None, (*sentences, self.cut_short)))

    @property
    def cut_short(self) -> str:
        """A sentence on the schemes that the search had no time to compile; empty if it tried all."""
        if not self.not_tried:
            return ""
        return (
            f"After {BUDGET:g} s no more schemes are compiled, so that these were not tried: {', '.join(self.not_tried)}. For one error "
            "vmri tune tries all."
        )

    def records(self) -> list[dict[str, Any]]:
        """A dictionary for each answer: the error and the columns of its run."""
        return [{"error": a.error, **(asdict(a.setting.row) if a.setting else {})} for a in self.rows]


def default_t_end(problem: Problem) -> float:
    """PERIODS periods of the fastest vibration, rounded to one digit; 1 if nothing vibrates."""
    frequency = float(diagnostics.frequencies(problem)[0])
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

    The page is rewritten after every error, so that a later failure loses no answer.

    Args:
        problem: system and start; a `Problem` or a scene.
        name: of the system, for the title and the commands: a built-in one or ``my_file.py:my_problem``.
        out: folder, made if it does not exist.
        t_end: simulated time, by default `default_t_end`.
        errors: largest accepted ``|q - q_ref|`` over ten nodes of the run; by default `RELATIVE_ERRORS` times how far the system moves.
        menu: families to choose from, by default `families()`.
        progress: True for a bar, or a function (what, done, total) that is told about every run.

    Raises:
        ValueError: errors that are not positive; no errors are passed, and the system does not move.
        SimulationError: no reference solution could be computed.
        Interrupted: Ctrl-C; the page has the errors that were searched for before.
        PageFailed: the page could not be drawn or written; carries the report.
    """
    problem = problem_of("cost_report", problem)
    out = Path(out)
    make_writable_folder(out)
    t_end = default_t_end(problem) if t_end is None else t_end
    reference = reference_solution(problem, t_end, progress=progress)
    if errors is None:
        errors = _default_errors(problem, reference, t_end)
    if not errors or min(errors) <= 0:
        raise ValueError(
            f"cost_report: errors are {list(errors)}; give positive numbers, in the unit of the positions."
        )
    search = Search(problem, t_end, families() if menu is None else menu, reference)
    answers, elapsed = [], stopwatch()
    with interruptible(search.rows):  # around the drawing as well, so that Ctrl-C there keeps the runs, too
        for i, error in enumerate(sorted(errors, reverse=True)):
            seconds_left = BUDGET - elapsed()
            settings = search.cheapest(error, part(progress, i, len(errors)), budget=seconds_left / 2)
            answers.append(Answer(error, settings[0] if settings else None))
            with suppress(PageFailed):  # the last call below raises it
                _write(search, answers, name, out)
        progress("runs with smaller steps", 1, 1)
        confirm(search)
        progress("measuring times", 1, 1)
        # times of runs that were made minutes apart differ with the load of the machine: time all schemes that the page shows again
        answer_schemes = [a.setting.row.scheme for a in _confirmed(search, answers) if a.setting is not None]
        stairs = staircases(search.rows().rows)
        stair_schemes = [stair.row.scheme for of_kind in stairs.values() for stair in of_kind]
        search.time_again({*answer_schemes, *stair_schemes})
        answers = _confirmed(search, answers)
        progress("shares of errors", 1, 1)
        stairs = with_shares(search, staircases(search.rows().rows))
        middle = answers[len(answers) // 2].error
        progress(f"accuracy {middle:.0e}", 1, 1)
        chosen = {"accuracy": _of_accuracy(search, middle), "accuracy_error": middle}
        report = _write(search, answers, name, out, stairs=stairs, **chosen)
    progress("done", 1, 1)
    return report


def _of_accuracy(search: Search, error: float) -> WorkRow | None:
    """The run that ``simulate(problem, accuracy=error)`` takes; None where it refuses the error, or finds no run."""
    problem, t_end, saves = search.problem, search.t_end, search.reference.num_saves
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # they say that a run misses the accuracy: the page shows its error
        try:
            best, settings = with_accuracy(problem, None, None, None, error, t_end=problem.t + t_end, num_saves=saves)
        except (ValueError, SimulationError):
            return None
    program = Program(problem, best.run.scheme, t_end, saves)
    row = work_row(settings.python, program, settings.num_steps, search.reference)
    return row.timed(program.seconds(settings.num_steps, REPEATS)) if np.isfinite(row.error_q) else None


def _default_errors(problem: Problem, reference: ReferenceSolution, t_end: float) -> list[float]:
    """RELATIVE_ERRORS of a power of ten near how far the system moves, without errors that the reference cannot tell."""
    moved = float(np.abs(reference.q - reference.q[0]).max())
    least = max(MIN_ERROR_OVER_REFERENCE * reference.error_q, round_off(problem)[1])
    motion = 10.0 ** math.floor(math.log10(max(moved, 1e-300)))
    errors = [motion * error for error in RELATIVE_ERRORS if motion * error > least]
    if not errors:
        raise ValueError(
            f"cost_report: until t_end = {t_end:g} the positions are those of the start up to {moved:.1e}, and errors below {least:.1e} "
            "cannot be told from round-off or from the error of the reference solution: the system is at rest or chaotic. Give a start that "
            "moves, another t_end, or the errors that you accept."
        )
    return errors


def _write(search: Search, answers: Sequence[Answer], name: str, out: Path, **later: Any) -> CostReport:
    """Write the page of the answers so far, and hand back its report; `later` has its fields from runs after the search."""
    answers = _fastest_that_keep(answers)
    runs, middle = search.rows(), answers[len(answers) // 2].setting
    price = prices(search.problem) if middle is not None else {}
    fields: dict[str, Any] = {"stairs": staircases(runs.rows), **later}
    report = CostReport(
        path=out / "cost.html",
        name=name,
        t_end=search.t_end,
        rows=tuple(answers),
        runs=runs,
        shares=shares(price, middle.row) if middle is not None else {},
        not_tried=tuple(search.not_tried()),
        **fields,
    )
    runs.to_csv(out / "cost.csv")
    try:
        _draw(report, search.problem, price)
    except Exception as error:
        raise PageFailed(report) from error
    return report


def _confirmed(search: Search, answers: Sequence[Answer]) -> list[Answer]:
    """The answers with the fastest setting whose confirmed error keeps the error; an answer without such a setting stays as it is."""
    settings = {(s.row.scheme, s.num_steps): s for s in search.settings.values()}
    stairs = confirmed([s.row for s in search.settings.values()])
    best = []
    for answer in answers:
        rows = [stair.row for stair in stairs if stair.error <= answer.error]
        row = min(rows, key=lambda row: row.seconds, default=None)
        best.append(answer if row is None else replace(answer, setting=settings[row.scheme, row.num_steps]))
    return best


def _fastest_that_keep(answers: Sequence[Answer]) -> list[Answer]:
    """The answers, the largest error first; each takes the setting of a smaller error where this is faster: it keeps the larger error as well.

    Such settings exist because the search compiles some schemes only for a smaller error, after it has answered the larger ones.
    """
    best, fastest = None, []
    for answer in reversed(answers):
        candidates = [setting for setting in (answer.setting, best) if setting is not None]
        best = min(candidates, key=lambda setting: setting.row.seconds, default=None)
        fastest.append(replace(answer, setting=best))
    return fastest[::-1]


def _draw(report: CostReport, problem: Problem, price: dict[str, float]) -> None:
    """The figures and the page of a report."""
    staircase_figure = partial(_draw_stairs, report, price)
    title = f"{report.name}: what accuracy costs over a time of {report.t_end:g}"
    for end, theme in (("", plots.LIGHT), ("_dark", plots.DARK)):
        plots.save(staircase_figure(title, theme), report.path.parent / f"cost{end}.png", theme)
    n_g, n_gs = problem.system.num_constraints(problem.q_s, problem.q_f)
    reached = [answer for answer in report.rows if answer.setting is not None]
    write_page(
        report.path,
        TEMPLATE,
        report=report,
        sizes={"slow variables": problem.q_s.size, "fast variables": problem.q_f.size, "constraints": n_g + n_gs},
        reached=reached,
        growth=_growth(reached),
        multirate=_multirate(report),
        duration=duration,
        work_precision=embedded(partial(staircase_figure, "")),
        shares_figure=embedded(partial(draw_shares, report.shares)),
    )


def _draw_stairs(report: CostReport, price: dict[str, float], title: str, theme: plots.Theme) -> plots.NotebookFigure:
    """The staircases with marks for the answers and the choice of `accuracy=`, and the bound."""
    rows = [answer.setting.row for answer in report.rows if answer.setting is not None]
    errors = {(s.row.scheme, s.row.num_steps): s.error for of_kind in report.stairs.values() for s in of_kind}
    marked = [
        plots.Marked("answers", row.seconds, errors.get((row.scheme, row.num_steps), row.error_q)) for row in rows
    ]
    chosen = report.accuracy
    if chosen is not None:
        marked.append(plots.Marked(f"accuracy={report.accuracy_error:.0e}", chosen.seconds, chosen.error_q, star=True))
    look = {"known_to": report.runs.reference.error_q, "title": title, "theme": theme}
    return plots.plot_staircases(report.stairs, marked, bound_of(report.stairs, price), **look)


def bound_of(stairs: dict[str, list[Stair]], price: dict[str, float]) -> plots.Bound | None:
    """The least time of micro steps over the time of single steps, if time is spent on gradients alone.

    N single steps evaluate both gradients, ``N (v + w)`` with v and w the prices of the gradients of V and W; one macro step of N
    micro steps takes ``v + N w``. N is the largest num_micro on the staircase of micro steps. None where V is not dearer than W, where
    the system has constraints or further potentials, or where a staircase is empty.
    """
    if price.keys() != {SLOW, FAST} or price[SLOW] <= price[FAST] or not (stairs.get(MICRO) and stairs.get(SINGLE)):
        return None
    n, v, w = max(stair.row.num_micro for stair in stairs[MICRO]), price[SLOW], price[FAST]
    return plots.Bound(f"bound: V + {n} W for {n} single steps", SINGLE, (v + n * w) / (n * (v + w)))


def _growth(reached: Sequence[Answer]) -> float:
    """Factor in time for a hundredth of the error, the geometric mean over the answers; NaN for fewer than two answers."""
    if len(reached) < 2:
        return math.nan
    first, last = reached[0], reached[-1]
    times = last.setting.row.seconds / first.setting.row.seconds  # pyright: ignore[reportOptionalMemberAccess]
    return times ** (math.log(100) / math.log(first.error / last.error))


def _multirate(report: CostReport) -> list[tuple[float, str, int, float]]:
    """For each answer: its error, family and num_micro, and the time of the family's single steps over the time of the answer.

    Single steps count if runs with more steps confirm that they keep the error, as of the answers: they never beat an answer.
    """
    stairs, gains = confirmed(report.runs.rows), []
    for error, setting in ((answer.error, answer.setting) for answer in report.rows if answer.setting is not None):
        single = setting.family.label(1)
        seconds = [stair.seconds for stair in stairs if stair.row.scheme == single and stair.error <= error]
        if seconds:
            gains.append((error, setting.family.name, setting.num_micro, min(seconds) / setting.row.seconds))
    return gains

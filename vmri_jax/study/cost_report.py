"""One page on what accuracy costs for a system: which scheme to take for which error, and where the time goes."""

import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from vmri_jax import diagnostics, plots
from vmri_jax.accuracy.families import Family, families
from vmri_jax.mechanics.state import HasProblem, Problem, problem_of
from vmri_jax.running.files import make_writable_folder
from vmri_jax.running.progress import Progress, part, silent
from vmri_jax.running.timing import seconds_each
from vmri_jax.study.advisor import MARGIN, Search, Setting, round_off
from vmri_jax.study.html import embedded, write_page
from vmri_jax.study.reference_solution import ReferenceSolution, reference_solution
from vmri_jax.study.table import Column, ResultTable
from vmri_jax.study.work import WorkPrecision, WorkRow, duration

TEMPLATE = Path(__file__).parent / "cost.html.j2"
PERIODS = 30
"""Simulated by default: so many periods of the fastest vibration."""
RELATIVE_ERRORS = (1e-2, 1e-4, 1e-6, 1e-8)
"""Errors asked for by default, relative to how far the system moves."""
BUDGET = 75.0
"""Seconds of search after which no more schemes are compiled. The first error may take half of them, for all are new to it, the
next one half of what is then left."""
SHOWN = 8
"""Schemes in the figure."""


@dataclass(frozen=True)
class Answer:
    """The cheapest setting for an error, None if nothing reached it, and all others that keep it, the fastest first."""

    error: float
    setting: Setting | None
    all: tuple[Setting, ...] = ()


class PageFailed(RuntimeError):
    """The search came to its end, but its page could not be drawn or written; what was found is in `.report` and in cost.csv."""

    def __init__(self, report: "CostReport"):
        self.report = report
        super().__init__(
            f"{report.path} could not be drawn or written; all runs are in {report.path.with_name('cost.csv')}."
        )


def _of_setting(form: Callable[[WorkRow], str]) -> Callable[[Answer], str]:
    """The text of the setting of an answer, empty if there is none."""
    return lambda answer: "" if answer.setting is None else form(answer.setting.row)


@dataclass(frozen=True)
class CostReport(ResultTable):
    """What was found, and where the page lies; its table has a line per answer.

    answers: by error, the largest first.
    runs: every run of the search.
    shares: parts of the time of the middle answer by what it is spent on.
    not_tried: schemes that the search had no time to compile.
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
    answers: tuple[Answer, ...]
    runs: WorkPrecision
    shares: dict[str, float]
    not_tried: tuple[str, ...] = ()

    @property
    def rows(self) -> tuple[Answer, ...]:
        """The answers."""
        return self.answers

    @property
    def caption(self) -> str:
        """The simulated time, and the errors that the reference solution lets be told: smaller ones are not asked for by default."""
        least = self.runs.reference.error_q
        told = (
            f" The reference solution is good to {least:.0e}: errors below {MARGIN * least:.0e} cannot be told."
            if least
            else ""
        )
        return " ".join(
            filter(None, (f"Runs to t = {self.t_end:g}, with errors of the positions there.{told}", self.cut_short))
        )

    @property
    def cut_short(self) -> str:
        """Which schemes the search had no time to compile; empty if it tried all."""
        if not self.not_tried:
            return ""
        return (
            f"After {BUDGET:g} s no more schemes are compiled, so that these were not tried: {', '.join(self.not_tried)}. For one error "
            "vmri tune tries all."
        )

    def records(self) -> list[dict[str, Any]]:
        """Errors and the runs that answer them."""
        return [{"error": a.error, **(asdict(a.setting.row) if a.setting else {})} for a in self.answers]


def default_t_end(problem: Problem) -> float:
    """PERIODS periods of the fastest vibration, rounded to one digit; 1 if nothing vibrates."""
    frequency = float(diagnostics.frequencies(problem)[0])
    if not frequency > 0:
        return 1.0
    t_end = PERIODS * 2 * math.pi / frequency
    return float(f"{t_end:.0e}")


def cost_report(
    problem: Problem | HasProblem,
    name: str,
    out: str | Path,
    *,
    t_end: float | None = None,
    errors: Sequence[float] | None = None,
    menu: Sequence[Family] | None = None,
    progress: Progress = silent,
) -> CostReport:
    """Search for the cheapest settings for a few errors and write ``cost.html``, ``cost.png`` and ``cost.csv``.

    The page is rewritten after every error, so that what is found is kept whatever happens later.

    Args:
        problem: system and start; a `Problem` or a scene.
        name: of the system, for the title and the commands: a built-in one or ``my_file.py:my_problem``.
        out: folder, made if it does not exist.
        t_end: simulated time, by default `default_t_end`.
        errors: largest ``|q - q_ref|`` at t_end; by default a ladder relative to how far the system moves.
        menu: families to choose from.
        progress: told what is running.

    Raises:
        ValueError: errors that are not positive; none are asked for, and the system does not move.
        SimulationError: no reference solution could be computed.
        Interrupted: Ctrl-C; the page has the errors that were searched for before.
        PageFailed: the page could not be drawn or written; carries the report.
    """
    problem = problem_of("cost_report", problem)
    out = Path(out)
    make_writable_folder(out)
    t_end = default_t_end(problem) if t_end is None else t_end
    reference = reference_solution(problem, t_end, num_saves=1, progress=progress)
    if errors is None:
        errors = _default_errors(problem, reference, t_end)
    if not errors or min(errors) <= 0:
        raise ValueError(
            f"cost_report: errors are {list(errors)}; give positive numbers, in the unit of the positions."
        )
    search = Search(problem, t_end, families() if menu is None else menu, reference)
    answers, deadline = [], time.monotonic() + BUDGET
    with search.kept():  # while the page is drawn, too
        for i, error in enumerate(sorted(errors, reverse=True)):
            left = deadline - time.monotonic()
            settings = search.cheapest(error, part(progress, i, len(errors)), budget=left / 2)
            answers.append(Answer(error, settings[0] if settings else None, tuple(settings)))
            with suppress(PageFailed):  # the page is drawn again, and its failure told, when all is known
                _write(search, answers, problem, name, out)
        progress("measuring times", 1, 1)
        search.time_again(_shown(answers))
        report = _write(search, answers, problem, name, out)
    progress("done", 1, 1)
    return report


def _default_errors(problem: Problem, reference: ReferenceSolution, t_end: float) -> list[float]:
    """RELATIVE_ERRORS of how far the system moves, those that the reference and round-off let be told.

    Raises:
        ValueError: there is none, as where nothing moves.
    """
    moved = float(np.abs(reference.q[-1] - reference.q[0]).max())
    least = max(MARGIN * reference.error_q, round_off(problem)[1])
    motion = 10.0 ** math.floor(math.log10(max(moved, 1e-300)))
    errors = [motion * error for error in RELATIVE_ERRORS if motion * error > least]
    if not errors:
        raise ValueError(
            f"cost_report: at t_end = {t_end:g} the positions are those of the start up to {moved:.1e}, and errors below {least:.1e} "
            "cannot be told from round-off or from the error of the reference solution: the system is at rest, back at its start, or "
            "chaotic. Give a start that moves, another t_end, or the errors that you accept."
        )
    return errors


def _write(search: Search, answers: Sequence[Answer], problem: Problem, name: str, out: Path) -> CostReport:
    """The page of what is known so far."""
    answers = _fastest_that_keep(answers)
    runs, shares = search.rows(), _shares(problem, answers[len(answers) // 2].setting)
    not_tried = tuple(search.not_tried())
    report = CostReport(out / "cost.html", name, search.t_end, tuple(answers), runs, shares, not_tried)
    labels = _shown(answers)
    runs.to_csv(out / "cost.csv")
    try:
        _draw(report, problem, labels)
    except Exception as error:
        raise PageFailed(report) from error
    return report


def _fastest_that_keep(answers: Sequence[Answer]) -> list[Answer]:
    """The answers, the largest error first, none slower than that for a smaller error: its setting keeps the larger error as well.

    Schemes that are compiled for a small error are not tried again at the larger ones before it.
    """
    best, made = None, []
    for answer in reversed(answers):
        known = [setting for setting in (answer.setting, best) if setting is not None]
        best = min(known, key=lambda setting: setting.row.seconds, default=None)
        made.append(replace(answer, setting=best))
    return made[::-1]


def _draw(report: CostReport, problem: Problem, labels: Sequence[str]) -> None:
    """The figure and the page of a report."""
    runs, name, out = report.runs, report.name, report.path.parent
    shown = replace(runs, rows=tuple(row for label in labels for row in runs.rows if row.scheme == label))
    title = f"{name}: what accuracy costs over a time of {report.t_end:g}"
    plots.save(plots.plot_work_precision(shown, title), out / "cost.png")
    n_g, n_gs = problem.system.num_constraints(problem.q_s, problem.q_f)
    reached = [answer for answer in report.answers if answer.setting is not None]
    write_page(
        report.path,
        TEMPLATE,
        report=report,
        sizes={"slow variables": problem.q_s.size, "fast variables": problem.q_f.size, "constraints": n_g + n_gs},
        reached=reached,
        growth=_growth(reached),
        multirate=_multirate(report),
        duration=duration,
        work_precision=embedded(partial(plots.plot_work_precision, shown, "", "seconds")),
        by_num_micro=embedded(partial(_draw_num_micro, report)),
        shares_figure=embedded(partial(_draw_shares, report)),
    )


def _shown(answers: Sequence[Answer]) -> list[str]:
    """Labels, with the best num_micro, of the families that are best for some error, or nearly so."""
    best: dict[str, tuple[float, str]] = {}
    for answer in answers:
        fastest = answer.setting.row.seconds if answer.setting else math.inf
        for setting in answer.all:
            found = setting.row.seconds / fastest, setting.row.scheme
            best[setting.family.name] = min(found, best.get(setting.family.name, (math.inf, "")))
    return [label for _, label in sorted(best.values())[:SHOWN]]


def _growth(reached: Sequence[Answer]) -> float:
    """Factor in time for a hundredth of the error, the geometric mean over the answers; NaN for less than two."""
    if len(reached) < 2:
        return math.nan
    first, last = reached[0], reached[-1]
    times = last.setting.row.seconds / first.setting.row.seconds  # pyright: ignore[reportOptionalMemberAccess]
    return times ** (math.log(100) / math.log(first.error / last.error))


def _multirate(report: CostReport) -> list[tuple[float, str, int, float]]:
    """By error: the family of the answer, its best num_micro, and how much faster than one micro step that is."""
    gains = []
    for answer in report.answers:
        if answer.setting is None:
            continue
        family = answer.setting.family.name
        single = [s.row.seconds for s in answer.all if s.family.name == family and s.num_micro == 1]
        if single:
            gains.append((answer.error, family, answer.setting.num_micro, single[0] / answer.setting.row.seconds))
    return gains


def _shares(problem: Problem, setting: Setting | None) -> dict[str, float]:
    """Parts of the time of a run: gradients of V and of W, constraints with their Jacobian, all the rest, further potentials included."""
    if setting is None:
        return {}
    system, row, n_s = problem.system, setting.row, problem.q_s.size

    def slow(q):
        return system.slow_potential(q[:n_s], q[n_s:], system.params)  # pyright: ignore[reportOptionalCall]

    def fast(q):
        return system.fast_potential(q[n_s:], system.params)  # pyright: ignore[reportOptionalCall]

    def constraints(q):
        return system.constraints(problem.t, q[:n_s], q[n_s:])

    terms = {}
    if system.slow_potential is not None:
        terms["gradient of V"] = jax.grad(slow), row.slow_evaluations
    if system.fast_potential is not None:
        terms["gradient of W"] = jax.grad(fast), row.fast_evaluations
    if any(system.num_constraints(problem.q_s, problem.q_f)):
        evaluations = row.fast_evaluations or row.slow_evaluations
        terms["constraints"] = lambda q: jax.jacrev(constraints)(q).sum(0) + constraints(q).sum(), evaluations
    q = jnp.concatenate([jnp.asarray(problem.q_s), jnp.asarray(problem.q_f)])
    shares = {name: seconds_each(f, q) * count / row.seconds for name, (f, count) in terms.items()}
    total = sum(shares.values())
    shares = {name: share / max(total, 1.0) for name, share in shares.items()}
    return shares | {"everything else": max(0.0, 1.0 - total)}


def _draw_num_micro(report: CostReport, theme: plots.Theme) -> Figure:
    """Time against num_micro of the families that were varied, at each error, one panel per error."""
    answers = [answer for answer in report.answers if answer.all]
    names = list(dict.fromkeys(s.family.name for answer in answers for s in answer.all[: 2 * SHOWN]))
    looks = {name: plots.curve_look(i, theme) for i, name in enumerate(names)}
    with plots.new_figure(7.2, 3.2, "", theme) as figure:
        panels = figure.subplots(1, max(1, len(answers)), sharey=True, squeeze=False)[0]
        for axes, answer in zip(panels, answers, strict=False):
            for name in names:
                settings = sorted((s for s in answer.all if s.family.name == name), key=lambda s: s.num_micro)
                if len(settings) >= 3:
                    x, y = [s.num_micro for s in settings], plots.positive([s.row.seconds for s in settings])
                    axes.loglog(x, y, label=name, markersize=3.5, linewidth=1.2, **looks[name])
            axes.set(title=f"error {answer.error:.0e}", xlabel="num_micro")
            plots.log_ticks(axes.xaxis, [s.num_micro for shown in answers for s in shown.all])
            axes.xaxis.set_major_formatter("{x:g}")
            plots.log_ticks(axes.yaxis, [s.row.seconds for shown in answers for s in shown.all])
        panels[0].set_ylabel("computing time")
        panels[0].yaxis.set_major_formatter(EngFormatter("s"))
        plots.legend_below(figure)
    return figure


def _draw_shares(report: CostReport, theme: plots.Theme) -> Figure:
    """One bar, cut by what the time is spent on."""
    with plots.new_figure(7.2, 1.1, "", theme) as figure:
        axes = figure.subplots()
        left = 0.0
        for color, (name, share) in zip(theme.curves, report.shares.items(), strict=False):
            last = name == "everything else"
            axes.barh([0], [share], left=left, color=theme.faint if last else color)
            if share > 0.06:
                ink = theme.ink if last else theme.paper
                axes.text(left + share / 2, 0, f"{name}\n{share:.0%}", ha="center", va="center", fontsize=8, color=ink)
            left += share
        axes.set(xlim=(0, 1))
        axes.set_axis_off()
    return figure

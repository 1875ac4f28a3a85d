"""Cost studies: computing time of a fixed simulated time against num_micro, at a constant micro step."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, NullLocator

from benchmarks.gail2014.dense import named
from vmri_jax import plots
from vmri_jax.mechanics.state import Problem
from vmri_jax.running.prepare import prepare
from vmri_jax.running.progress import Progress, silent
from vmri_jax.running.simulation import Simulation
from vmri_jax.running.timing import interleaved, stopwatch
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.results import Method, Result
from vmri_jax.study.table import ResultTable


@dataclass(frozen=True)
class CostRow:
    """One program: its size and its times.

    label: of the system or the scheme, as passed to `cost_study`.
    method: of the curve.
    num_unknowns: unknowns of one macro step, ``r n_s + r n_gs + num_micro r (n_f + n_g)``, r the degree.
    num_steps: macro steps of the timed run.
    seconds_per_unit: computing time per unit of simulated time; the figures of the reference paper up to a constant.
    us_per_micro_step: computing time per micro step, in microseconds.
    first_call_seconds: tracing and compiling, without a macro step; not part of the other times.
    iterations: most Newton iterations of a step.
    solved_by: name of the `Method` that took the steps, which "auto" chooses, as in ``run.info.method``.
    result: name of the `Result` of the run.
    us_in_short_step: microseconds per micro step in the macro step of `Curve.settled` micro steps; NaN where that was
        not timed.
    samples: microseconds per micro step, in turns with all other programs of the study; not in files.
    """

    label: str
    method: str
    num_micro: int
    num_unknowns: int
    num_steps: int
    seconds_per_unit: float
    us_per_micro_step: float
    first_call_seconds: float
    iterations: int
    solved_by: str
    result: str
    us_in_short_step: float = float("nan")
    samples: tuple[float, ...] = ()


@dataclass(frozen=True, repr=False)
class CostStudy(ResultTable):
    """Rows of one or several cost studies."""

    columns = ()  # files alone hold them
    rows: tuple[CostRow, ...]

    @property
    def curves(self) -> list[tuple[str, str]]:
        """The ``(label, method)`` pairs."""
        return list(dict.fromkeys((row.label, row.method) for row in self.rows))

    def curve(self, label: str, method: str) -> tuple[np.ndarray, np.ndarray]:
        """``num_micro`` and microseconds per micro step of one curve; failed runs are NaN."""
        rows = [row for row in self.rows if (row.label, row.method) == (label, method)]
        if not rows:
            raise ValueError(f"curve: no {(label, method)} in this study; it has {self.curves}.")
        return np.array([row.num_micro for row in rows]), np.array([row.us_per_micro_step for row in rows])

    def samples(self, method: str) -> dict[int, tuple[float, ...]]:
        """Samples of the runs of a method that were timed, by num_micro."""
        rows = (row for row in self.rows if row.method == method and np.isfinite(row.us_per_micro_step))
        return {row.num_micro: row.samples for row in rows}

    def records(self) -> list[dict[str, Any]]:
        return [{name: value for name, value in vars(row).items() if name != "samples"} for row in self.rows]

    def __add__(self, other: "CostStudy") -> "CostStudy":
        return CostStudy(self.rows + other.rows)


@dataclass(frozen=True)
class Curve:
    """What one curve of a cost study runs.

    method: of Newton's iteration: a matrix of `vmri_jax.Solver`, or "dense", the method of the reference paper.
    problem: system and start.
    num_micro: numbers of micro steps per macro step.
    t_end: simulated time, rounded to whole macro steps: long enough (thousands of micro steps for small systems) that
        the start of a program takes a negligible part of the time.
    settled: number of micro steps in whose macro step the runs with more of them are timed, too, by the same programs:
        what their cost is without the length of their own macro steps. 0 for none.
    """

    method: str
    problem: Problem
    num_micro: Sequence[int]
    t_end: float
    settled: int = 0


def cost_study(
    label: str,
    scheme: Callable[[int], Scheme],
    curves: Sequence[Curve],
    *,
    micro_dt: float,
    repeats: int = 5,
    min_seconds: float = 0.1,
    progress: Progress = silent,
) -> CostStudy:
    """Time ``scheme(n)`` for every num_micro n of every curve; times are per unit of simulated time and per micro step.

    All programs take turns in every repeat, so that a slow moment of the machine hits all of them; a row has the
    median.

    Args:
        label: name of this scheme or system in the rows.
        scheme: the scheme for a num_micro, e.g. `vmri_jax.fully_implicit`.
        curves: at least one.
        micro_dt: the constant micro step h.
        repeats: timed samples of each program.
        min_seconds: seconds of a sample, the mean of several calls.
        progress: told about every program before it is compiled, and once before times are measured.
    """
    points = [(curve, n) for curve in curves for n in curve.num_micro]
    runs: list[tuple[Curve, Simulation, float, Trajectory]] = []
    for curve, n in points:
        progress(f"{label} {curve.method}, {n} micro steps: compiling".strip(), len(runs), len(points) + 1)
        num_steps, elapsed = max(1, round(curve.t_end / (n * micro_dt))), stopwatch()
        length = {"macro_dt": n * micro_dt, "num_steps": num_steps, "save": num_steps}
        program = prepare(curve.problem, scheme(n), **length, solver=named(curve.method))
        runs.append((curve, program, elapsed(), program(throw=False)))
    progress(f"{label} measuring times".strip(), len(points), len(points) + 1)
    calls = {}
    for i, (curve, program, _, run) in enumerate(runs):
        if run.success:
            calls[f"{i}"] = program.timed()
            if 0 < curve.settled < program.scheme.num_micro:
                calls[f"{i}, short steps"] = program.timed(macro_dt=curve.settled * micro_dt)
    seconds = interleaved(calls, repeats, min_seconds)
    progress("done", 1, 1)
    samples = [[seconds.get(f"{i}{end}", [np.nan]) for end in ("", ", short steps")] for i in range(len(runs))]
    return CostStudy(tuple(_row(label, *run, *of_run) for run, of_run in zip(runs, samples, strict=True)))


def _row(
    label: str,
    curve: Curve,
    program: Simulation,
    first_call_seconds: float,
    trajectory: Trajectory,
    seconds: Sequence[float],
    seconds_in_short_steps: Sequence[float],
) -> CostRow:
    """The row of a run with its samples of seconds."""
    scheme = program.scheme
    micro_steps = program.num_steps * scheme.num_micro
    return CostRow(
        label=label,
        method=curve.method,
        num_micro=scheme.num_micro,
        num_unknowns=unknowns(curve.problem, scheme),
        num_steps=program.num_steps,
        seconds_per_unit=float(np.median(seconds)) / (program.num_steps * float(program.macro_dt)),
        us_per_micro_step=1e6 * float(np.median(seconds)) / micro_steps,
        first_call_seconds=first_call_seconds,
        iterations=int(np.max(trajectory.info.iterations)),
        solved_by=Method(int(np.max(trajectory.info.method))).name,
        result=Result(int(trajectory.result)).name,
        us_in_short_step=1e6 * float(np.median(seconds_in_short_steps)) / micro_steps,
        samples=tuple(1e6 * s / micro_steps for s in seconds),
    )


def unknowns(problem: Problem, scheme: Scheme | Composition) -> int:
    """Number of unknowns of one macro step, for which the dense solve solves at once."""
    n_g, n_gs = problem.system.num_constraints(problem.q_s, problem.q_f)
    return scheme.degree * (problem.q_s.size + n_gs + scheme.num_micro * (problem.q_f.size + n_g))


def plot_cost(
    studies: Mapping[str, Any],
    paper_minima: Mapping[str, int] | None = None,
    title: str = "",
    theme: plots.Theme = plots.LIGHT,
) -> plots.NotebookFigure:
    """Computing time per micro step against num_micro, one panel per study, the cheapest point of each curve circled.

    Args:
        studies: by the title of their panel, e.g. of `cost_study`.
        paper_minima: num_micro to mark, by the title of the panel.
        title: title above the panels.
        theme: colours.
    """
    columns = 2 if len(studies) == 4 else min(3, len(studies))
    height = 0.6 + 2.7 * math.ceil(len(studies) / columns)
    with plots.new_figure(max(5.2, 0.6 + 3.0 * columns), height, title, theme) as figure:
        grid = plots.panel_grid(figure, len(studies), columns, "micro steps per macro step", "µs per micro step")
        for axes, (name, study) in zip(grid, studies.items(), strict=True):
            _cost_panel(axes, study, (paper_minima or {}).get(name), theme)
            axes.set(title=name)
        plots.legend_below(figure)
    return figure


def _cost_panel(axes: Axes, study: Any, paper_minimum: int | None, theme: plots.Theme) -> None:
    one_label = len({label for label, _ in study.curves}) == 1
    curves = [study.curve(label, method) for label, method in study.curves]
    for i, ((label, method), (num_micro, cost)) in enumerate(zip(study.curves, curves, strict=True)):
        name = method if one_label else f"{label}, {method}"
        look = plots.curve_look(i, theme)
        axes.loglog(num_micro, cost, markersize=4, label=name, **look)
        if np.isfinite(cost).any():
            best = np.nanargmin(cost)
            axes.plot(num_micro[best], cost[best], "o", markersize=11, markerfacecolor="none", color=look["color"])
    if paper_minimum is not None:
        axes.axvline(paper_minimum, color=theme.ink, linestyle=":", linewidth=1.1, label="minimum in the paper")
    ticks = np.unique(np.concatenate([num_micro for num_micro, _ in curves]))
    if len(ticks) > 7:
        ticks = np.array([1, 4, 12, 40, 100])
    axes.xaxis.set_major_locator(FixedLocator(ticks.tolist()))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter("{x:.0f}")
    plots.log_ticks(axes.yaxis, np.concatenate([cost for _, cost in curves]))

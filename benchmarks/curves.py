"""Time per micro step against num_micro at a constant micro step, by the default solve and by the dense one."""

import math
from dataclasses import dataclass, field, replace
from functools import partial

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullFormatter, NullLocator

import vmri_jax as vm
from benchmarks import programs
from benchmarks.gail2014.dense import dense
from benchmarks.gail2014.reference import unstructured
from benchmarks.measure import Ratio, Tell, interleaved, quartiles, ratio, silent, steps_for
from benchmarks.report import spread
from vmri_jax import plots
from vmri_jax.plots import legend_below

TIME = "µs/micro step"
FROM = 10
"""From so many micro steps on the default solve is held against the dense one."""


@dataclass(frozen=True)
class Case:
    """One system under one scheme, over the same simulated time for every num_micro.

    dense_num_micro: where the dense solve runs too.
    turn: the most that the largest num_micro may cost per micro step, over the cheapest.
    dense: the least that the dense solve must cost over the default one, from FROM micro steps on.
    """

    system: str
    scheme: str
    micro_dt: float
    num_micro: tuple[int, ...]
    dense_num_micro: tuple[int, ...] = ()
    turn: float | None = None
    dense: float | None = None

    @property
    def label(self) -> str:
        """Name in tables and figures."""
        return f"{self.system}, {self.scheme}"

    def affordable(self, most_unknowns: int) -> "Case":
        """The dense solve only where it has at most so many unknowns."""
        problem = programs.problem(self.system)
        return replace(
            self,
            dense_num_micro=tuple(n for n in self.dense_num_micro if programs.unknowns(problem, n) <= most_unknowns),
        )


@dataclass(frozen=True)
class Curves:
    """What measuring a `Case` gave: microseconds per micro step by method and num_micro, one per sample."""

    case: Case
    samples: dict[tuple[str, int], list[float]]
    rows: list[dict] = field(default_factory=list)

    def curve(self, method: str) -> tuple[np.ndarray, np.ndarray]:
        """num_micro and the median microseconds per micro step."""
        points = sorted((n, float(np.median(us))) for (m, n), us in self.samples.items() if m == method)
        num_micro, us = zip(*points, strict=True) if points else ((), ())
        return np.array(num_micro), np.array(us)

    def turn(self) -> Ratio | None:
        """The largest num_micro over the cheapest, None if it did not run."""
        num_micro, us = self.curve("auto")
        if max(self.case.num_micro) not in num_micro:
            return None
        return ratio(*(self.samples["auto", int(n)] for n in (num_micro[-1], num_micro[np.argmin(us)])))

    def dense(self) -> Ratio | None:
        """The dense solve over the default one where they are closest, None where it did not run."""
        both = [n for m, n in self.samples if m == "dense" and n >= FROM and ("auto", n) in self.samples]
        ratios = [ratio(self.samples["dense", n], self.samples["auto", n]) for n in both]
        return min(ratios, key=lambda r: r.value, default=None)


def measure(case: Case, repeats: int, seconds: float, tell: Tell = silent) -> Curves:
    """Time every program of a case in turn; those whose run fails are left out of the samples.

    The default solve takes every num_micro over the same simulated time, the dense one, much slower, a few macro steps.
    """
    problem = programs.problem(case.system)
    runs, results, total = {}, {}, 0
    for n in case.num_micro:
        tell(f"{case.label}, num_micro {n}")
        run = programs.program(problem, programs.SCHEMES[case.scheme](n), n * case.micro_dt)
        if not total:  # of micro steps, one that all num_micro divide
            unit = math.lcm(*case.num_micro)
            total = n * steps_for(run, seconds, unit // n)
        runs["auto", n] = partial(run, total // n), total
        results["auto", n] = run(total // n)
    whole = problem
    if case.system.startswith("FPU") and case.scheme != "fully implicit":
        whole = unstructured(problem)  # explicit schemes solve for the whole macro step too, as the paper did
    for n in case.dense_num_micro:
        tell(f"{case.label}, num_micro {n}, dense")
        run = programs.program(whole, programs.SCHEMES[case.scheme](n), n * case.micro_dt, dense())
        num_steps = steps_for(run, seconds / 2, 3, 300)
        runs["dense", n] = partial(run, num_steps), num_steps * n
        results["dense", n] = run(num_steps)

    good = {key: run for key, (run, _) in runs.items() if not programs.failed(results[key])}
    timed = interleaved({str(key): run for key, run in good.items()}, repeats)
    jax.clear_caches()  # hundreds of programs are more memory maps than a process may have
    samples = {key: [1e6 * s / runs[key][1] for s in timed[str(key)]] for key in good}
    curves = Curves(case, samples)
    for method, n in runs:
        curves.rows.append(_row(curves, problem, method, n, runs[method, n][1], results[method, n]))
    return curves


def _row(curves: Curves, problem, method: str, n: int, micro_steps: int, trajectory: vm.Trajectory) -> dict:
    case, us = curves.case, curves.samples.get((method, n))
    seen = quartiles(us or [math.nan])
    _, all_of_them = curves.curve(method)
    return {
        "case": case.label,
        "method": method,
        "num_micro": n,
        "unknowns": programs.unknowns(problem, n),
        "micro_dt": case.micro_dt,
        "micro steps": micro_steps,
        **spread(TIME, seen),
        "to cheapest": seen.value / float(all_of_them.min()) if us else math.nan,
        "iterations": int(np.max(trajectory.info.iterations)),
        "result": vm.Result(int(trajectory.result)).name,
    }


def draw(curves: list[Curves], title: str, columns: int) -> Figure:
    """One panel per case: the default solve, the dense one, and the cheapest point of each."""
    lines = -(-len(curves) // columns)
    with plots.new_figure(max(6.0, 0.6 + 2.6 * columns), 1.1 + 2.1 * lines, title, plots.LIGHT) as figure:
        panels = figure.subplots(lines, columns, squeeze=False, sharex=True).reshape(-1)
        for axes, found in zip(panels, curves, strict=False):
            _panel(axes, found)
        for axes in panels[len(curves) :]:
            axes.set_axis_off()
        for axes in panels[max(0, len(curves) - columns) : len(curves)]:
            axes.set(xlabel="micro steps per macro step")
            axes.xaxis.set_tick_params(labelbottom=True)
        for axes in panels[::columns]:
            axes.set(ylabel="µs per micro step")
        legend_below(figure)
    return figure


def _panel(axes: Axes, found: Curves) -> None:
    theme = plots.LIGHT
    values = []
    for i, (method, name) in enumerate((("auto", "default"), ("dense", "dense Newton"))):
        num_micro, us = found.curve(method)
        if not len(us):
            continue
        axes.loglog(num_micro, us, marker=plots.MARKERS[i], markersize=4, color=theme.curves[i], label=name)
        best = np.argmin(us)
        axes.plot(num_micro[best], us[best], "o", markersize=11, markerfacecolor="none", color=theme.curves[i])
        values += list(us)
    axes.set_title(found.case.label, fontsize=9)
    if values:
        axes.set_ylim(min(values) / 2, max(max(values), 10 * min(values)) * 2)
    axes.xaxis.set_major_locator(FixedLocator([1, 4, 12, 40, 100]))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter("{x:.0f}")
    axes.yaxis.set_minor_formatter(NullFormatter())

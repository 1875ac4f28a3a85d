"""Figures of studies and searches: errors against steps and work; controls, motion and iterations; misses of a fit."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter
from scipy import stats

from vmri_jax.plots.runs import coordinates, limit_times, position_panels
from vmri_jax.plots.theme import (
    LIGHT,
    ROUNDOFF_FLOOR,
    NotebookFigure,
    Theme,
    curve_look,
    legend_below,
    legend_beside,
    log_ticks,
    new_figure,
    positive,
)
from vmri_jax.refusals import Refused

DEVIATIONS_OF_95_PERCENT = 1.96
"""Half width of the interval that holds 95 % of a normal distribution, in standard deviations."""
MEANING = {"update": "update", "gap": "gaps of steps", "miss": "goal missed by", "over": "limits exceeded by"}
"""Names in the legend, by the keys in the history of an optimisation."""


def plot_convergence(study: Any, orders: Sequence[int] = (), title: str = "", theme: Theme = LIGHT) -> NotebookFigure:
    """Errors of positions and of momenta against the macro step, with guide triangles of the given slopes.

    The legend has the observed orders of both.

    Args:
        study: result of `vmri_jax.study.convergence_study`.
        orders: slopes to draw for comparison.
        title: title above the panels.
        theme: colours.
    """
    with new_figure(7.6, 3.7, title, theme) as figure:
        panels = figure.subplots(1, 2, sharex=True)
        for axes, quantity, name in zip(panels, ("q", "p"), ("positions", "momenta"), strict=True):
            steps = []
            for i, scheme in enumerate(study.schemes):
                macro_dt, errors = study.errors(scheme, quantity)
                label = f"{scheme}   {_orders(study, scheme)}"
                axes.loglog(macro_dt, positive(errors), label=label, **curve_look(i, theme))
                steps += list(macro_dt)
            for order in orders:
                _guide_triangle(axes, study, quantity, order, theme)
            axes.set(title=name, xlabel="macro step $H$")
            axes.set(ylabel=rf"largest error $|{quantity} - {quantity}_{{\mathrm{{ref}}}}|$")
            log_ticks(axes.xaxis, steps)
            log_ticks(axes.yaxis, [])
        legend_below(figure)
    return figure


def _orders(study: Any, scheme: str) -> str:
    """The observed orders of positions and of momenta in words."""
    orders = {quantity: study.order(scheme, quantity) for quantity in ("q", "p")}
    if not np.isfinite([*orders.values()]).any():
        return "failed"
    observed = (f"{order:.2f} ({q})" if np.isfinite(order) else f"failed ({q})" for q, order in orders.items())
    return "order " + ", ".join(observed)


WORK = {
    "seconds": "computing time of the run",
    "slow_evaluations": r"evaluations of $\nabla V$",
    "fast_evaluations": r"evaluations of $\nabla W$",
    "solves": "systems of equations solved",
}
"""Labels of the axis of work in `plot_work_precision`, by the names of the attributes of the rows."""


def plot_work_precision(
    study: Any,
    title: str = "",
    work: str = "seconds",
    theme: Theme = LIGHT,
    *,
    ringed: Sequence[Any] = (),
    bound: Sequence[tuple[float, float]] = (),
) -> NotebookFigure:
    """Error of the positions against work, one curve per scheme; the Pareto front is underlaid.

    Args:
        study: `vmri_jax.study.WorkPrecision`: ``study.work()`` of a convergence study, or the runs of a recommendation.
        title: title above the panel.
        work: "seconds", "slow_evaluations", "fast_evaluations" or "solves".
        theme: colours.
        ringed: rows to mark with rings, as chosen.
        bound: work and error of points of a lower bound.

    Raises:
        ValueError: work is another string.
    """
    if work not in WORK:
        raise Refused(f"plot_work_precision: work is {work!r}; it must be one of {', '.join(WORK)}.")
    front = [row for row in study.pareto(work) if getattr(row, work) > 0]
    with new_figure(7.2, 4.3, title, theme) as figure:
        axes = figure.subplots()
        best, errors = [getattr(row, work) for row in front], positive([row.error_q for row in front])
        under = {"color": theme.faint, "linewidth": 7, "solid_capstyle": "round", "zorder": 1}
        axes.loglog(best, errors, label="best of all", **under)
        for i, scheme in enumerate(study.schemes):
            curve = sorted(study.curve(scheme), key=lambda row: row.num_steps * row.num_micro)
            x, y = (positive([getattr(row, name) for row in curve]) for name in (work, "error_q"))
            axes.loglog(x, y, label=scheme, markersize=4, linewidth=1.1, **curve_look(i, theme))
        if bound:
            x, y = (positive(values) for values in zip(*bound, strict=True))
            axes.loglog(x, y, color=theme.rod, linestyle=":", label="bound: gradients alone")
        if ringed:
            x, y = (positive([getattr(row, name) for row in ringed]) for name in (work, "error_q"))
            look: dict[str, Any] = {"linestyle": "", "markerfacecolor": "none", "markersize": 13, "color": theme.ink}
            axes.loglog(x, y, "o", label="chosen", **look)
        axes.set(xlabel=WORK[work], ylabel="largest error of a position")
        axes.set_ylim(top=30 * np.nanmax(errors, initial=0.0) or None)
        if study.known_to > axes.get_ylim()[0]:
            axes.axhline(study.known_to, color=theme.ink, linewidth=0.8, linestyle=":")
            above: dict[str, Any] = {"ha": "right", "va": "bottom", "fontsize": 7.5}
            axes.text(0.995, study.known_to, "error of the reference ", transform=axes.get_yaxis_transform(), **above)
        log_ticks(axes.xaxis, [getattr(row, work) for scheme in study.schemes for row in study.curve(scheme)])
        if work == "seconds":
            axes.xaxis.set_major_formatter(EngFormatter("s"))
        legend_below(figure)
    return figure


def _guide_triangle(axes: Axes, study: Any, quantity: str, order: int, theme: Theme) -> None:
    """Draw a triangle of slope `order` just below the most accurate curve whose order is within 0.5 of it."""
    lowest = None
    for scheme in study.schemes:
        macro_dt, errors = study.usable(scheme, quantity)
        if len(errors) > 1 and abs(study.order(scheme, quantity) - order) < 0.5:
            middle = (len(errors) - 1) // 2
            value = errors[middle] / macro_dt[middle] ** order
            if lowest is None or value < lowest[0]:
                lowest = value, macro_dt[middle], errors[middle]
    if lowest is None:
        return
    _, right, top = lowest
    left, top = right / 2, top / 2.5
    bottom = top / 2**order
    axes.fill([left, right, right], [bottom, bottom, top], facecolor=theme.faint, edgecolor="none", zorder=1)
    beside: dict[str, Any] = {"textcoords": "offset points", "va": "center", "fontsize": 8.5}
    axes.annotate(f"{order}", (right, (bottom * top) ** 0.5), (4, 0), **beside)


def plot_control(optimum: Any, *, title: str = "", theme: Theme = LIGHT) -> NotebookFigure:
    """Controls with their bounds, slow and fast positions against time, and update, gaps and misses of every iteration.

    Args:
        optimum: result of `vmri_jax.control.minimize`.
        title: title above the panels.
        theme: colours.
    """
    t, panels = np.asarray(optimum.trajectory.t), position_panels(optimum.trajectory)
    with new_figure(7.2, 0.6 + 1.85 * (2 + len(panels)), title, theme) as figure:
        above, *middle, below = figure.subplots(2 + len(panels))
        edges = np.append(optimum.t.ravel(), t[-1])
        controls = optimum.controls.reshape(len(edges) - 1, -1)
        for number, (column, label) in enumerate(zip(controls.T, optimum.labels, strict=True)):
            color = theme.curves[number % len(theme.curves)]
            above.stairs(column, edges, baseline=None, color=color, linewidth=1.4, label=label)
            for bound in (side[number] for side in optimum.bounds if np.isfinite(side[number])):
                above.axhline(bound, color=color, linewidth=0.8, linestyle=":")
        above.set(ylabel="controls $u$")
        limit_times(above, t)
        legend_beside(above)
        for axes, (values, labels, quantity, _) in zip(middle, panels, strict=True):
            coordinates(axes, t, values, labels, quantity, theme)
        (middle or [above])[-1].set_xlabel("time $t$")
        for name, color in zip(("update", "gap", "miss", "over"), theme.curves, strict=False):
            values = np.array([iteration[name] for iteration in optimum.history])
            if np.any(values > 0):
                numbers = 1 + np.arange(len(values))
                below.semilogy(numbers, np.maximum(values, ROUNDOFF_FLOOR), ".-", color=color, label=MEANING[name])
        count = len(optimum.history)
        below.set(xlabel="iteration", ylabel="remaining error", xticks=1 + np.arange(0, count, 1 + count // 12))
        legend_beside(below)
        figure.align_ylabels()
    return figure


def plot_fit(fit: Any, *, title: str = "", theme: Theme = LIGHT) -> NotebookFigure:
    """Residuals against time, their distribution, and the correlations of several parameters.

    Args:
        fit: result of `vmri_jax.fit`.
        title: title above the panels.
        theme: colours.
    """
    with new_figure(11, 3.6, title, theme) as figure:
        widths = [2, 1, 1.2] if len(fit.labels) > 1 else [2, 1]
        over_time, spread, *correlations = figure.subplots(1, len(widths), width_ratios=widths)
        first = 0
        for number, m in enumerate(fit.shooting.data):
            is_number = np.isfinite(m.values)
            misses = np.full(m.values.shape, np.nan)
            misses[is_number] = fit.residuals[first : first + is_number.sum()]
            first += int(is_number.sum())
            over_time.plot(m.t, misses, ".", markersize=2, color=f"C{number}")
        over_time.axhspan(-DEVIATIONS_OF_95_PERCENT, DEVIATIONS_OF_95_PERCENT, alpha=0.12)
        over_time.set(xlabel="t", ylabel="miss / sigma", title="misses, and where 95 % of them belong")

        width = max(4.0, float(np.abs(fit.residuals).max()))
        x = np.linspace(-width, width, 200)
        spread.hist(fit.residuals, bins=40, range=(-width, width), density=True, alpha=0.6)
        spread.plot(x, stats.norm.pdf(x))
        spread.set(xlabel="miss / sigma", title="their distribution", yticks=[])

        for correlation in correlations:
            errors = np.sqrt(np.diag(fit.covariance))
            image = correlation.imshow(fit.covariance / np.outer(errors, errors), vmin=-1, vmax=1, cmap="RdBu")
            correlation.set_xticks(range(len(fit.labels)), fit.labels, rotation=45, ha="right")
            correlation.set_yticks(range(len(fit.labels)), fit.labels)
            correlation.set_title("correlations")
            correlation.grid(False)
            figure.colorbar(image, ax=correlation)
    return figure

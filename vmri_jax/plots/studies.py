"""Figures of studies: convergence, error against work, computing time."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter, FixedLocator, NullLocator

from vmri_jax.plots.theme import (
    LIGHT,
    NotebookFigure,
    Theme,
    curve_look,
    legend_below,
    log_ticks,
    mark_reference,
    new_figure,
    panel_grid,
    positive,
)


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
                axes.loglog(
                    macro_dt, positive(errors), label=f"{scheme}   {_orders(study, scheme)}", **curve_look(i, theme)
                )
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


def plot_work_precision(study: Any, title: str = "", work: str = "seconds", theme: Theme = LIGHT) -> NotebookFigure:
    """Error of the positions against work, one curve per scheme; the Pareto front is underlaid.

    Args:
        study: result of `vmri_jax.study.work_precision`, or the runs of a recommendation.
        title: title above the panel.
        work: "seconds", "slow_evaluations", "fast_evaluations" or "solves".
        theme: colours.

    Raises:
        ValueError: work is another string.
    """
    if work not in WORK:
        raise ValueError(f"plot_work_precision: work is {work!r}; it must be one of {', '.join(WORK)}.")
    front = [row for row in study.pareto(work) if getattr(row, work) > 0]
    with new_figure(7.2, 4.3, title, theme) as figure:
        axes = figure.subplots()
        best, errors = [getattr(row, work) for row in front], positive([row.error_q for row in front])
        under = {"color": theme.faint, "linewidth": 7, "solid_capstyle": "round", "zorder": 1}
        axes.loglog(best, errors, label="best of all", **under)
        for i, scheme in enumerate(study.schemes):
            curve = sorted(study.curve(scheme), key=lambda row: row.num_steps)
            x, y = (positive([getattr(row, name) for row in curve]) for name in (work, "error_q"))
            axes.loglog(x, y, label=scheme, markersize=4, linewidth=1.1, **curve_look(i, theme))
        axes.set(xlabel=WORK[work], ylabel=r"largest error $|q - q_{\mathrm{ref}}|$")
        axes.set_ylim(top=30 * np.nanmax(errors, initial=0.0) or None)
        mark_reference(axes, study.reference.error_q, theme)
        log_ticks(axes.xaxis, [getattr(row, work) for scheme in study.schemes for row in study.curve(scheme)])
        if work == "seconds":
            axes.xaxis.set_major_formatter(EngFormatter("s"))
        legend_below(figure)
    return figure


def plot_cost(
    studies: Mapping[str, Any],
    paper_minima: Mapping[str, int] | None = None,
    title: str = "",
    theme: Theme = LIGHT,
) -> NotebookFigure:
    """Computing time per micro step against num_micro, one panel per study, the cheapest point of each curve circled.

    Args:
        studies: by the title of their panel, e.g. of `vmri_jax.study.cost_study`.
        paper_minima: num_micro to mark, by the title of the panel.
        title: title above the panels.
        theme: colours.
    """
    columns = 2 if len(studies) == 4 else min(3, len(studies))
    height = 0.6 + 2.7 * math.ceil(len(studies) / columns)
    with new_figure(max(5.2, 0.6 + 3.0 * columns), height, title, theme) as figure:
        grid = panel_grid(figure, len(studies), columns)
        for axes, (name, study) in zip(grid, studies.items(), strict=True):
            _cost_panel(axes, study, (paper_minima or {}).get(name), theme)
            axes.set(title=name)
        for axes in grid[-columns:]:
            axes.set(xlabel="micro steps per macro step")
        for axes in grid[::columns]:
            axes.set(ylabel="µs per micro step")
        legend_below(figure)
    return figure


def _cost_panel(axes: Axes, study: Any, paper_minimum: int | None, theme: Theme) -> None:
    one_label = len({label for label, _ in study.curves}) == 1
    curves = [study.curve(label, method) for label, method in study.curves]
    for i, ((label, method), (num_micro, cost)) in enumerate(zip(study.curves, curves, strict=True)):
        name = method if one_label else f"{label}, {method}"
        look = curve_look(i, theme)
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
    log_ticks(axes.yaxis, np.concatenate([cost for _, cost in curves]))


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
    axes.annotate(
        f"{order}", (right, (bottom * top) ** 0.5), (4, 0), textcoords="offset points", va="center", fontsize=8.5
    )

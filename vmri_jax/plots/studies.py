"""Figures of studies: convergence, and error against work."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter

from vmri_jax.plots.theme import (
    LIGHT,
    NotebookFigure,
    Theme,
    curve_look,
    legend_below,
    log_ticks,
    mark_reference,
    new_figure,
    positive,
)
from vmri_jax.refusals import Refused


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
        mark_reference(axes, study.known_to, theme)
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

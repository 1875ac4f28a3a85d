"""Figures of optimal control: the controls, the motion under them, and the convergence of the iteration."""

from typing import Any

import numpy as np

from vmri_jax.plots.runs import coordinates, limit_times, position_panels
from vmri_jax.plots.theme import LIGHT, ROUNDOFF_FLOOR, NotebookFigure, Theme, legend_beside, new_figure


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
            coordinates(axes, t, values, labels, theme)
            axes.set(ylabel=quantity)
            limit_times(axes, t)
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


MEANING = {"update": "update", "gap": "gaps of steps", "miss": "goal missed by", "over": "limits exceeded by"}
"""Names in the legend, by the keys in the history of an optimisation."""

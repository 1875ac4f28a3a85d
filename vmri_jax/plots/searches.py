"""Figures of searches: controls with their motion and the iteration, parameters with the residuals of measurements."""

from typing import Any

import numpy as np
from scipy import stats

from vmri_jax.plots.runs import coordinates, limit_times, position_panels
from vmri_jax.plots.theme import LIGHT, ROUNDOFF_FLOOR, NotebookFigure, Theme, legend_beside, new_figure

DEVIATIONS_OF_95_PERCENT = 1.96
"""Half width of the interval that holds 95 % of a normal distribution, in standard deviations."""
MEANING = {"update": "update", "gap": "gaps of steps", "miss": "goal missed by", "over": "limits exceeded by"}
"""Names in the legend, by the keys in the history of an optimisation."""


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

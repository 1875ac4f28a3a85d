"""Figures of fits: residuals of the measurements and correlations of the parameters."""

from typing import Any

import numpy as np
from scipy import stats

from vmri_jax.plots.theme import LIGHT, NotebookFigure, Theme, new_figure

DEVIATIONS_OF_95_PERCENT = 1.96
"""Half width of the interval that holds 95 % of a normal distribution, in standard deviations."""


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

"""Pictures of the cases where one helps: unstable omega H, linkages at their singularity, three scales."""

import numpy as np
from matplotlib.figure import Figure

from vmri_jax import plots
from vmri_jax.hard_cases.case import Details


def draw_windows(details: Details, theme: plots.Theme) -> Figure:
    """Unstable intervals of omega H / pi of the linear model, one line per num_micro."""
    with plots.new_figure(7.2, 2.6, "", theme) as figure:
        axes = figure.subplots()
        for k, ((_, windows), color) in enumerate(zip(details.items(), theme.curves, strict=False)):
            bars = [(start / np.pi, (stop - start) / np.pi) for start, stop in windows]
            axes.broken_barh(bars, (k - 0.35, 0.7), facecolor=color, edgecolor=color, linewidth=1.0)
        axes.set(xlabel=r"$\omega H / \pi$", ylabel="num_micro", xlim=(0, 4), title="unstable steps")
        axes.set_yticks(range(len(details)), details)
        axes.grid(axis="y", visible=False)
    return figure


def draw_singular(details: Details, theme: plots.Theme) -> Figure:
    """Height of the crank through the collinear position, and the falling chain, started straight."""
    with plots.new_figure(7.2, 3.2, "", theme) as figure:
        left, right = figure.subplots(1, 2)
        left.plot(details["t"], details["height"], color=theme.curves[0])
        left.axhline(0.0, color=theme.ink, linewidth=0.5, linestyle=":")
        left.set(xlabel="time", ylabel="height of the crank", title="four-bar linkage, collinear at 0")
        shapes = details["chain"].reshape(len(details["chain"]), -1, 2)
        for k, points in enumerate(shapes):
            last = k == len(shapes) - 1
            color = theme.curves[1] if last else theme.curves[0]
            right.plot(*points.T, color=color, linewidth=1.3 if last else 0.7, alpha=1.0 if last else 0.6)
        right.set(xlabel="x", ylabel="y", title="chain, started straight", aspect="equal")
    return figure


def draw_oscillatory_energies(details: Details, theme: plots.Theme) -> Figure:
    """Oscillatory energies of the three stiff springs, large steps over resolved ones."""
    with plots.new_figure(7.2, 3.2, "", theme) as figure:
        axes = figure.subplots()
        for i, color in zip(range(2), theme.curves, strict=False):
            axes.plot(details["t"], details["fine"][:, i], color=color, linewidth=0.7, alpha=0.5)
            axes.plot(details["t"], details["coarse"][:, i], color=color, linewidth=1.0, label=f"$I_{i + 1}$")
        axes.set(xlabel="time", ylabel="oscillatory energy", xlim=(0, details["t"][-1]))
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure

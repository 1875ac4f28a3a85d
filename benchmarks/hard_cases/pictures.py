"""Pictures of the cases where one helps: linkages at their singularity, three scales."""

import numpy as np
from matplotlib.figure import Figure

from vmri_jax import plots
from vmri_jax.running.trajectory import Trajectory

THEME = plots.LIGHT


def draw_singular(linkage: Trajectory, chain: Trajectory) -> Figure:
    """Height of the crank through the collinear position, and the falling chain, started straight."""
    with plots.new_figure(7.2, 3.2, "", THEME) as figure:
        left, right = figure.subplots(1, 2)
        left.plot(linkage.t[:201], linkage.q_f[:201, 1], color=THEME.curves[0])
        left.axhline(0.0, color=THEME.ink, linewidth=0.5, linestyle=":")
        left.set(xlabel="time", ylabel="height of the crank", title="four-bar linkage, collinear at 0")
        shapes = chain.q_f[:201:20]
        for k, points in enumerate(shapes.reshape(len(shapes), -1, 2)):
            last = k == len(shapes) - 1
            color = THEME.curves[1] if last else THEME.curves[0]
            right.plot(*points.T, color=color, linewidth=1.3 if last else 0.7, alpha=1.0 if last else 0.6)
        right.set(xlabel="x", ylabel="y", title="chain, started straight", aspect="equal")
    return figure


def draw_oscillatory_energies(t: np.ndarray, coarse: np.ndarray, fine: np.ndarray) -> Figure:
    """Oscillatory energies of the three stiff springs, large steps over resolved ones."""
    with plots.new_figure(7.2, 3.2, "", THEME) as figure:
        axes = figure.subplots()
        for i, color in zip(range(2), THEME.curves, strict=False):
            axes.plot(t, fine[:, i], color=color, linewidth=0.7, alpha=0.5)
            axes.plot(t, coarse[:, i], color=color, linewidth=1.0, label=f"$I_{i + 1}$")
        axes.set(xlabel="time", ylabel="oscillatory energy", xlim=(0, t[-1]))
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure

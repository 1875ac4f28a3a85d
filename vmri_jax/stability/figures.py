"""Figures of stability maps: stable and unstable regions side by side."""

from collections.abc import Mapping

import numpy as np
from matplotlib.colors import LinearSegmentedColormap, LogNorm
from matplotlib.patches import Patch

from vmri_jax.plots import LIGHT, NotebookFigure, Theme, style
from vmri_jax.stability.map import StabilityMap

SHOWN = (1e-5, 1.0)
"""Growth per step from the faintest to the full colour."""
COLUMNS = 3


def plot_stability(maps: Mapping[str, StabilityMap], title: str = "", theme: Theme = LIGHT) -> NotebookFigure:
    """Unstable regions over ``omega H / pi`` and the rows of each map, one panel per map; colour is growth per step.

    Windows narrower than the grid are drawn as lines. Rows are stacked from the bottom in their order.

    Args:
        maps: maps by the title of their panel, e.g. one per scheme, each over num_micro or kappa.
        title: over the figure.
        theme: colours.
    """
    columns = min(COLUMNS, len(maps))
    lines = -(-len(maps) // columns)
    height = max(1.6, 0.9 + 0.17 * max(len(m.rows) for m in maps.values()))
    colors = LinearSegmentedColormap.from_list("growth", [theme.faint, theme.curves[1], theme.ink])
    with style(theme):
        figure = NotebookFigure(figsize=(max(5.2, 0.9 + 2.9 * columns), 0.9 + height * lines))
        panels = figure.subplots(lines, columns, squeeze=False, sharex=False).reshape(-1)
        norm = LogNorm(*SHOWN, clip=True)
        mesh = None
        for axes, (name, stability) in zip(panels, maps.items(), strict=False):
            growth = np.ma.masked_equal(stability.growth, 0.0)
            x, y = stability.omega_H / np.pi, np.arange(len(stability.rows))
            mesh = axes.pcolormesh(_cells(x), _cells(y), growth, norm=norm, cmap=colors)
            for i, edges in enumerate(stability.edges):
                narrow = [(a + b) / 2 / np.pi for a, b in edges if (b - a) / np.pi < 1.5 * np.diff(x).max()]
                axes.vlines(narrow, i - 0.5, i + 0.5, color=theme.curves[1], linewidth=0.8)
            axes.set(title=name, xlim=(0, x[-1]), ylim=(-0.5, len(y) - 0.5))
            shown = y[:: -(-len(y) // 14)]
            axes.set_yticks(shown, [_label(stability.rows[i]) for i in shown])
            axes.grid(axis="y", visible=False)
            if stability.axis == "kappa" or all(isinstance(row, int) for row in stability.rows):
                axes.set(ylabel="kappa" if stability.axis == "kappa" else "micro steps per macro step")
        for axes in panels[len(maps) :]:
            axes.set_axis_off()
        for axes in panels[max(0, len(maps) - columns) : len(maps)]:
            axes.set(xlabel=r"$\omega H / \pi$")
        if mesh is not None:
            figure.colorbar(mesh, ax=panels.tolist(), label="growth per macro step", aspect=30, pad=0.01)
        figure.legend(handles=[Patch(facecolor=theme.paper, edgecolor=theme.ink, label="stable")], loc="outside lower right")
        figure.suptitle(title, x=0.01, ha="left")
    return figure


def _cells(centres) -> np.ndarray:
    """Edges of cells around increasing centres."""
    if len(centres) == 1:
        return centres[0] + np.array([-0.5, 0.5])
    middle = (centres[1:] + centres[:-1]) / 2
    return np.concatenate([[2 * centres[0] - middle[0]], middle, [2 * centres[-1] - middle[-1]]])


def _label(row) -> str:
    return f"{row:g}" if isinstance(row, float) else str(row)

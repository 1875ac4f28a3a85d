"""Figures of stability maps: stable and unstable regions side by side."""

import math
from collections.abc import Mapping

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, LogNorm

from vmri_jax.plots import LIGHT, NotebookFigure, Theme, new_figure, panel_grid
from vmri_jax.stability.map import StabilityMap

GROWTHS_SHOWN = (1e-6, 1.0)
"""Growth per step of the faintest and of the full colour."""
COLUMNS = 3
"""Most panels in a row."""


def plot_stability(maps: Mapping[str, StabilityMap], title: str = "", theme: Theme = LIGHT) -> NotebookFigure:
    """Unstable windows over ``omega H / pi`` and the rows of each map, one panel per map.

    The colour of a window is its largest growth per step. Rows are stacked from the bottom: systems with numbers as
    labels at these heights, all others in their order.

    Args:
        maps: maps by the title of their panel, e.g. one per scheme, each over num_micro or systems.
        title: title above the panels.
        theme: colours.
    """
    columns = min(COLUMNS, len(maps))
    height = float(np.clip(0.9 + 0.17 * max(len(m.rows) for m in maps.values()), 1.6, 3.2))
    shades = LinearSegmentedColormap.from_list("growth", [theme.curves[4], theme.curves[1], theme.ink])
    colors = ScalarMappable(LogNorm(*GROWTHS_SHOWN, clip=True), shades)
    size = max(5.2, 0.9 + 2.9 * columns), 0.9 + height * math.ceil(len(maps) / columns)
    with new_figure(*size, title, theme) as figure:
        panels = panel_grid(figure, len(maps), columns, r"$\omega H / \pi$")
        for axes, (name, stability) in zip(panels, maps.items(), strict=True):
            over_numbers = stability.axis == "system" and all(isinstance(row, float) for row in stability.rows)
            y = np.array(stability.rows, dtype=float) if over_numbers else np.arange(len(stability.rows))
            edges = _cells(y)
            for windows, bottom, top in zip(stability.unstable, edges, edges[1:], strict=False):
                shade = colors.to_rgba(np.array([window.growth for window in windows]))
                spans = [(w.start / np.pi, (w.stop - w.start) / np.pi) for w in windows]
                axes.broken_barh(spans, (bottom, top - bottom), facecolors=shade, edgecolors=shade, linewidth=0.7)
            axes.set(title=name, xlim=(0, stability.omega_H[-1] / np.pi), ylim=(edges[0], edges[-1]))
            if not over_numbers:
                axes.set_yticks(y, [str(row) for row in stability.rows])
                axes.grid(axis="y", visible=False)
            if all(isinstance(row, int) for row in stability.rows):
                axes.set(ylabel="micro steps per macro step")
        figure.colorbar(colors, ax=panels.tolist(), label="growth per macro step\n(blank: stable)", aspect=30, pad=0.01)
    return figure


def _cells(centres) -> np.ndarray:
    """(k + 1,) edges of cells around k increasing centres, halfway between neighbours."""
    if len(centres) == 1:
        return centres[0] + np.array([-0.5, 0.5])
    middle = (centres[1:] + centres[:-1]) / 2
    return np.concatenate([[2 * centres[0] - middle[0]], middle, [2 * centres[-1] - middle[-1]]])

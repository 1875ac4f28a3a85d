"""Figures in one style: trajectories, conserved quantities, convergence and computing time.

Every function returns a matplotlib `Figure` made without pyplot: no window opens, no global setting is touched, and a
notebook shows it when it is the value of a cell. Colours follow Okabe and Ito, told apart by the colour-blind.
"""

from vmri_jax.plots.ensembles import plot_ensemble
from vmri_jax.plots.runs import plot_forces, plot_trajectory
from vmri_jax.plots.studies import plot_control, plot_convergence, plot_fit, plot_work_precision
from vmri_jax.plots.theme import (
    DARK,
    LIGHT,
    MARKERS,
    NotebookFigure,
    Theme,
    curve_look,
    legend_below,
    log_ticks,
    new_figure,
    panel_grid,
    positive,
    save,
    style,
)

__all__ = [
    "DARK",
    "LIGHT",
    "MARKERS",
    "NotebookFigure",
    "Theme",
    "curve_look",
    "legend_below",
    "log_ticks",
    "new_figure",
    "panel_grid",
    "plot_control",
    "plot_convergence",
    "plot_ensemble",
    "plot_fit",
    "plot_forces",
    "plot_trajectory",
    "plot_work_precision",
    "positive",
    "save",
    "style",
]

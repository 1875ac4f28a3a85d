"""The picture of a long run: its energy error as a band."""

import numpy as np
from matplotlib.figure import Figure

from vmri_jax import plots
from vmri_jax.hard_cases.case import Details

BANDS = 400
"""Pieces of a run for which least and largest error are drawn, about a pixel wide; more pieces make larger files."""


def draw_energy(details: Details, theme: plots.Theme) -> Figure:
    """Energy error against time, for every run the band between its least and largest error."""
    runs = [name.removeprefix("t") for name in details if name == "t" or name.startswith("t ")]
    with plots.new_figure(7.2, 3.2, "", theme) as figure:
        axes = figure.subplots()
        for name, color in zip(runs, theme.curves, strict=False):
            t, e = details[f"t{name}"], details[f"energy error{name}"]
            starts = np.arange(0, len(t), max(1, len(t) // BANDS))
            low, high = np.minimum.reduceat(e, starts), np.maximum.reduceat(e, starts)
            label = f"tolerance {name.strip()}" if name else None
            axes.fill_between(t[starts], low, high, color=color, alpha=0.8, lw=0.6, label=label)
        axes.set(xlabel="time", ylabel=r"energy error $E - E_0$", xlim=(0, details[f"t{runs[0]}"][-1]))
        if len(runs) > 1:
            axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure

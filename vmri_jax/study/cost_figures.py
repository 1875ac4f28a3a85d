"""A figure of the page of `cost_report`: the parts of the time of a run."""

from collections.abc import Mapping

from matplotlib.figure import Figure

from vmri_jax import plots
from vmri_jax.study.prices import REMAINDER

MIN_LABELLED_SHARE = 0.06
"""Parts of a bar below this share of the time have no room for a label."""


def draw_shares(shares: Mapping[str, float], theme: plots.Theme) -> Figure:
    """One bar for the time of a run, cut into the parts of `vmri_jax.study.prices.shares`, which sum to 1."""
    with plots.new_figure(7.2, 1.1, "", theme) as figure:
        axes = figure.subplots()
        left = 0.0
        for color, (name, share) in zip(theme.curves, shares.items(), strict=False):
            last = name == REMAINDER
            axes.barh([0], [share], left=left, color=theme.faint if last else color)
            if share > MIN_LABELLED_SHARE:
                ink = theme.ink if last else theme.paper
                axes.text(left + share / 2, 0, f"{name}\n{share:.0%}", ha="center", va="center", fontsize=8, color=ink)
            left += share
        axes.set(xlim=(0, 1))
        axes.set_axis_off()
    return figure

"""Figures of the page of `cost_report`: times against num_micro, and the parts of the time of a run."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from vmri_jax import plots
from vmri_jax.study.prices import REMAINDER

MAX_CURVES = 4
"""Families per panel of `draw_num_micro`; more curves cover each other."""
MIN_POINTS = 3
"""Least numbers of micro steps in a curve; families with fewer are not drawn."""
MIN_LABELLED_SHARE = 0.06
"""Parts of a bar below this share of the time have no room for a label."""


def draw_num_micro(answers: Sequence[Any], theme: plots.Theme) -> Figure:
    """Time against num_micro, a panel for each answer of a `CostReport`, a curve for each family with several num_micro."""
    answers = [answer for answer in answers if answer.all]
    varied = [
        [name for name, count in Counter(s.family.name for s in answer.all).items() if count >= MIN_POINTS][:MAX_CURVES]
        for answer in answers
    ]
    names = list(dict.fromkeys(name for panel_names in varied for name in panel_names))
    looks = {name: plots.curve_look(i, theme) for i, name in enumerate(names)}
    with plots.new_figure(7.2, 3.2, "", theme) as figure:
        panels = figure.subplots(1, max(1, len(answers)), sharey=True, squeeze=False)[0]
        for axes, answer, panel_names in zip(panels, answers, varied, strict=False):
            for name in panel_names:
                settings = sorted((s for s in answer.all if s.family.name == name), key=lambda s: s.num_micro)
                x, y = [s.num_micro for s in settings], plots.positive([s.row.seconds for s in settings])
                axes.loglog(x, y, label=name, markersize=3.5, linewidth=1.2, **looks[name])
            axes.set(title=f"error {answer.error:.0e}", xlabel="num_micro")
            plots.log_ticks(axes.xaxis, [s.num_micro for shown in answers for s in shown.all])
            axes.xaxis.set_major_formatter("{x:g}")
            plots.log_ticks(axes.yaxis, [s.row.seconds for shown in answers for s in shown.all])
        panels[0].set_ylabel("computing time")
        panels[0].yaxis.set_major_formatter(EngFormatter("s"))
        plots.legend_below(figure)
    return figure


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

"""Figures of the page of cost: staircases, times against num_micro, parts of the time."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from vmri_jax import plots
from vmri_jax.study.prices import REST

CURVES = 4
"""Families whose times against num_micro are drawn."""


def draw_num_micro(answers: Sequence[Any], theme: plots.Theme) -> Figure:
    """Time against num_micro of the families that were varied, at each error, one panel per error.

    Args:
        answers: of a `CostReport`.
        theme: colours.
    """
    answers = [answer for answer in answers if answer.all]
    varied = [
        [name for name in {s.family.name: None for s in answer.all} if _numbers(answer, name) >= 3][:CURVES]
        for answer in answers
    ]
    names = list(dict.fromkeys(name for of_answer in varied for name in of_answer))
    looks = {name: plots.curve_look(i, theme) for i, name in enumerate(names)}
    with plots.new_figure(7.2, 3.2, "", theme) as figure:
        panels = figure.subplots(1, max(1, len(answers)), sharey=True, squeeze=False)[0]
        for axes, answer, of_answer in zip(panels, answers, varied, strict=False):
            for name in of_answer:
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


def _numbers(answer: Any, name: str) -> int:
    """Numbers of micro steps of a family that keep the error of an answer."""
    return sum(s.family.name == name for s in answer.all)


def draw_shares(shares: Mapping[str, float], theme: plots.Theme) -> Figure:
    """One bar, cut by what the time is spent on.

    Args:
        shares: parts of the time, by their names.
        theme: colours.
    """
    with plots.new_figure(7.2, 1.1, "", theme) as figure:
        axes = figure.subplots()
        left = 0.0
        for color, (name, share) in zip(theme.curves, shares.items(), strict=False):
            last = name == REST
            axes.barh([0], [share], left=left, color=theme.faint if last else color)
            if share > 0.06:
                ink = theme.ink if last else theme.paper
                axes.text(left + share / 2, 0, f"{name}\n{share:.0%}", ha="center", va="center", fontsize=8, color=ink)
            left += share
        axes.set(xlim=(0, 1))
        axes.set_axis_off()
    return figure

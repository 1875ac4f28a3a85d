"""Staircases of error against computing time: the least error that each kind of schemes reaches in a time."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.colors import to_hex, to_rgb
from matplotlib.ticker import EngFormatter

from vmri_jax.plots.theme import (
    LIGHT,
    NotebookFigure,
    Theme,
    legend_below,
    log_ticks,
    mark_reference,
    new_figure,
    positive,
)

MARKERS = ("s", "o", "D", "P")
"""Markers of the kinds of schemes, in the order of the kinds."""


class Marked(NamedTuple):
    """A run with a separate mark.

    label: name in the legend.
    seconds: computing time.
    error: largest error of a position.
    star: whether the mark is a star; else it is a ring.
    """

    label: str
    seconds: float
    error: float
    star: bool = False


class Bound(NamedTuple):
    """Lower bound of the time with N micro steps per macro step.

    It is the time of single steps as small as the micro steps, without the slow forces that a macro step saves.

    label: name in the legend.
    kind: kind of schemes with single steps, whose times are multiplied by `factor`.
    factor: ``(v + N w) / (N (v + w))`` with the seconds v and w of an evaluation of the slow and of the fast force.
    """

    label: str
    kind: str
    factor: float


def plot_staircases(
    kinds: Mapping[str, Sequence[Any]],
    marked: Sequence[Marked] = (),
    bound: Bound | None = None,
    *,
    known_to: float = 0.0,
    title: str = "",
    theme: Theme = LIGHT,
) -> NotebookFigure:
    """Staircases of the error that each kind of schemes reaches in a computing time.

    The colour of a corner is mixed from the colours of the slow and the fast share of its error.

    Args:
        kinds: staircases of `vmri_jax.study.staircase` by kind, the fastest run first, at most four; a kind without runs reserves its colour and marker.
        marked: runs to mark.
        bound: lower bound of the times with micro steps.
        known_to: error of the reference solution.
        title: title above the panel.
        theme: colours.
    """
    blue, orange, green, purple, gold, *_ = theme.curves
    colors = purple, green, gold, theme.ink
    with new_figure(7.2, 4.4, title, theme) as figure:
        axes = figure.subplots()
        axes.set(xscale="log", yscale="log", xlabel="computing time of the run", ylabel="largest error of a position")
        for color, marker, (kind, stairs) in zip(colors, MARKERS, kinds.items(), strict=False):
            if not stairs:
                continue
            x, y = [stair.seconds for stair in stairs], positive([stair.error for stair in stairs])
            axes.step(x, y, where="post", color=color, linewidth=1.6, zorder=2)
            for stair in stairs:
                face = _mixed(blue, orange, stair.fast_share) if np.isfinite(stair.fast_share) else theme.paper
                axes.plot(
                    stair.seconds, *positive([stair.error]), marker, color=color, markerfacecolor=face, markersize=6.5
                )
            axes.plot([], [], marker=marker, color=color, linewidth=1.6, markerfacecolor=theme.paper, label=kind)
        if bound is not None and bound.kind in kinds:
            stairs = kinds[bound.kind]
            x, y = [bound.factor * stair.seconds for stair in stairs], positive([stair.error for stair in stairs])
            axes.step(x, y, where="post", color=theme.rod, linestyle=":", linewidth=1.3, label=bound.label, zorder=1.5)
        for run in marked:
            look: dict[str, Any] = {"marker": "*", "markersize": 15} if run.star else {"marker": "o", "markersize": 13}
            look |= {"linestyle": "", "color": theme.ink, "markerfacecolor": gold if run.star else "none"}
            axes.plot(run.seconds, *positive([run.error]), label=run.label, **look)
        if any(np.isfinite(stair.fast_share) for stairs in kinds.values() for stair in stairs):
            for name, color in (("error of the macro steps", blue), ("error of the micro steps", orange)):
                axes.plot([], [], "o", color=theme.rod, markerfacecolor=color, markersize=7, label=name)
        mark_reference(axes, known_to, theme)
        log_ticks(axes.xaxis, [stair.seconds for stairs in kinds.values() for stair in stairs])
        axes.xaxis.set_major_formatter(EngFormatter("s"))
        legend_below(figure)
    return figure


def _mixed(slow: str, fast: str, share: float) -> str:
    """The colour ``(1 - share) slow + share fast``, channel by channel."""
    red, green, blue = ((1 - share) * a + share * b for a, b in zip(to_rgb(slow), to_rgb(fast), strict=True))
    return to_hex((red, green, blue))

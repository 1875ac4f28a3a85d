"""Figures of the benchmark: error against time, and the gain of micro steps against the price of the slow force."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter

from vmri_jax import plots
from vmri_jax.plots.theme import legend_below, log_ticks

PANELS = ("64 molecules", "network", "spacecraft")
"""Systems of the figure; where none of them was measured, the first ones that were."""
TITLE = "Where micro steps pay: slow forces that are dear"
GAIN_TITLE = "gain of micro steps; lines: the bound"
COMPOSED = ("suzuki4", "kahan-li6")


def ratio_at(single: tuple[np.ndarray, np.ndarray], error: float, ms: float) -> float | None:
    """Time of single steps at this error, between those measured, over `ms`; None outside of them."""
    if not len(single[0]):
        return None
    errors, times = (np.log(part[np.argsort(single[0])]) for part in single)
    if not errors[0] <= np.log(error) <= errors[-1]:
        return None
    return float(np.exp(np.interp(np.log(error), errors, times)) / ms)


def time_to(error: float, steps: np.ndarray, errors: np.ndarray, ms: np.ndarray) -> float:
    """Milliseconds at an error, between those measured; infinite outside of them."""
    between = ratio_at((errors, ms), error, 1.0)
    return np.inf if between is None else between


def bound(num_micro: int, price):
    """``N (v + w) / (v + N w)`` for a price v / w."""
    return num_micro * (price + 1) / (price + num_micro)


FAMILIES: dict[str, tuple[Callable[[str], bool], int | str, str, str, float]] = {
    "single steps": (lambda name: name == "kicks, N = 1", 1, "-", "s", 1.8),
    "micro steps": (lambda name: name.startswith("kicks, N = ") and name != "kicks, N = 1", 0, "-", "o", 2.6),
    "order 4 or 6, single steps": (lambda name: name in {f"{c}, N = 1" for c in COMPOSED}, 1, ":", "D", 1.4),
    "order 4 or 6, micro steps": (
        lambda name: name.startswith(COMPOSED) and not name.endswith("N = 1"),
        0,
        ":",
        "v",
        1.4,
    ),
    "three rates": (lambda name: name.startswith("three rates"), 2, "-", "^", 2.0),
    "one interval of degree 6": (lambda name: name.startswith("one interval"), 3, "-", "P", 1.4),
    "diffrax": (lambda name: name.startswith("diffrax"), 4, "--", "s", 1.4),
    "OpenMM": (lambda name: name.startswith("OpenMM"), "rod", "--", "D", 1.4),
    "C loop": (lambda name: name.startswith("C loop"), "ink", "--", "^", 1.4),
}
"""Of each family: its schemes, the colour of the theme, line, marker and width. Micro steps are in full colour, single
steps of the same order beside them, other programs dashed."""


def families(curves: Mapping[str, Any], target: float) -> dict[str, tuple[str, Any]]:
    """The curves that are drawn, by family: single steps, and of all others the one that reaches the target first."""
    chosen = {}
    for family, (has, *_) in FAMILIES.items():
        names = [name for name in curves if has(name)]
        best = min(names, key=lambda name: time_to(target, *curves[name]), default=None)
        if best is not None and len(curves[best][0]):
            chosen[family] = best, curves[best]
    return chosen


def _look(family: str, theme: plots.Theme) -> dict[str, Any]:
    _, color, line, marker, width = FAMILIES[family]
    color = getattr(theme, color) if isinstance(color, str) else theme.curves[color]
    face = {"markerfacecolor": theme.paper, "markersize": 4.5}
    return {"color": color, "linestyle": line, "marker": marker, "linewidth": width, **face}


def draw_errors(curves: Mapping[str, Mapping[str, Any]], gains: Sequence[Any], target: float, theme: plots.Theme):
    """Error against time, a panel for each of three systems, and the gain against the price in the last one.

    Args:
        curves: by system and scheme.
        gains: of all systems.
        target: the error that times are compared at.
        theme: colours.
    """
    shown = [name for name in PANELS if name in curves] or list(curves)[:3]
    with plots.new_figure(9.0, 7.0 if len(shown) > 1 else 3.8, TITLE, theme) as figure:
        panels = plots.panel_grid(figure, len(shown) + 1, 2)
        for axes, system in zip(panels, shown, strict=False):
            ms = []
            for family, (_, (_, errors, milliseconds)) in families(curves[system], target).items():
                axes.loglog(1e-3 * milliseconds, errors, label=family, **_look(family, theme))
                ms += list(1e-3 * milliseconds)
            axes.axhline(target, color=theme.ink, linewidth=0.8, linestyle=":")
            axes.set(title=system, xlabel="computing time", ylabel="error of the positions")
            log_ticks(axes.xaxis, ms)
            axes.xaxis.set_major_formatter(EngFormatter("s"))
        _gain_panel(panels[-1], gains, theme)
        legend_below(figure)
    return figure


def _gain_panel(axes: Axes, gains: Sequence[Any], theme: plots.Theme) -> None:
    """Points with the names of their systems, a line down from the bound of each."""
    blue, orange, *_ = theme.curves
    axes.set(xscale="log", yscale="log")
    prices = np.geomspace(1.0, 2.0 * max([gain.price for gain in gains], default=10.0), 100)
    for num_micro in sorted({gain.num_micro for gain in gains}):
        bounds = bound(num_micro, prices)
        axes.plot(prices, bounds, color=theme.rod, linewidth=1.0, linestyle="-")
        axes.annotate(
            f"N = {num_micro}", (prices[-1], bounds[-1]), (-2, 2), textcoords="offset points", ha="right", fontsize=8
        )
    for gain in gains:
        axes.plot([gain.price] * 2, [gain.gain, gain.bound], color=theme.faint, linewidth=1.2, zorder=1)
        axes.plot(gain.price, gain.bound, "_", color=theme.rod, markersize=9)
        are_molecules = gain.title.endswith("molecules")
        axes.plot(
            gain.price, gain.gain, "o" if are_molecules else "s", color=blue if are_molecules else orange, markersize=6
        )
        name = gain.title.removesuffix(" molecules")
        on_the_left = gain.title == "network"  # which is as dear as the spacecraft
        beside = {"xytext": (-7, -2) if on_the_left else (7, -2), "ha": "right" if on_the_left else "left"}
        axes.annotate(name, (gain.price, gain.gain), textcoords="offset points", fontsize=8.5, **beside)
    axes.set(title=GAIN_TITLE, xlabel="price of V over the price of W", ylabel="single steps over micro steps")
    log_ticks(axes.yaxis, [1.0, *(gain.gain for gain in gains)])
    axes.yaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_major_formatter("{x:g}")

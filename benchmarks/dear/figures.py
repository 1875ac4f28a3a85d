"""Figures of the benchmark: error against time, and the gain of micro steps against the price of the slow force."""

from collections.abc import Mapping, Sequence
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


def families(curves: Mapping[str, Any], target: float) -> dict[str, tuple[str, Any]]:
    """The curves that are drawn, by family: single steps, and of all others the one that reaches the target first."""

    def best(names: Sequence[str]) -> str | None:
        return min(names, key=lambda name: time_to(target, *curves[name]), default=None)

    groups = {
        "single steps": [name for name in curves if name == "kicks, N = 1"],
        "micro steps": [name for name in curves if name.startswith("kicks, N = ") and name != "kicks, N = 1"],
        "order 4 or 6, single steps": [name for name in curves if name in {f"{c}, N = 1" for c in COMPOSED}],
        "order 4 or 6, micro steps": [n for n in curves if n.startswith(COMPOSED) and not n.endswith("N = 1")],
        "three rates": [name for name in curves if name.startswith("three rates")],
        "one interval of degree 6": [name for name in curves if name.startswith("one interval")],
        "diffrax": [name for name in curves if name.startswith("diffrax")],
        "OpenMM": [name for name in curves if name.startswith("OpenMM")],
        "C loop": [name for name in curves if name.startswith("C loop")],
    }
    chosen = {family: best(names) for family, names in groups.items()}
    return {
        family: (name, curves[name]) for family, name in chosen.items() if name is not None and len(curves[name][0])
    }


def _look(family: str, theme: plots.Theme) -> dict[str, Any]:
    """Micro steps in full colour, single steps of the same order beside them, other programs dashed."""
    blue, orange, green, purple, gold, _ = theme.curves
    looks = {
        "single steps": (orange, "-", "s", 1.8),
        "micro steps": (blue, "-", "o", 2.6),
        "order 4 or 6, single steps": (orange, ":", "D", 1.4),
        "order 4 or 6, micro steps": (blue, ":", "v", 1.4),
        "three rates": (green, "-", "^", 2.0),
        "one interval of degree 6": (purple, "-", "P", 1.4),
        "diffrax": (gold, "--", "s", 1.4),
        "OpenMM": (theme.rod, "--", "D", 1.4),
        "C loop": (theme.ink, "--", "^", 1.4),
    }
    color, line, marker, width = looks[family]
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
        bounds = num_micro * (prices + 1) / (prices + num_micro)
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

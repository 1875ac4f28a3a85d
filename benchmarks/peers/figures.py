"""Work-precision diagrams: error against time, one figure per family of problems, ours on top."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatterSciNotation, LogLocator, NullFormatter

from benchmarks.peers.cases import LEVELS
from benchmarks.peers.scan import Point, front
from vmri_jax import plots
from vmri_jax.plots import legend_below

FAMILIES = {"FPU": "Fermi-Pasta-Ulam chain", "TSP": "Triple spherical pendulum", "SAM": "Simple atomic model"}
COLORS = (
    *("#0072b2", "#d55e00", "#009e73", "#66c9a9", "#a3508a", "#d3a5c5"),
    *("#b98700", "#56a0d3", "#8a6d5a", "#5f6b75", "#d680a8", "#9aa5ae"),
)
SHOWN = (2e-10, 5e-2)
"""Errors between which a figure goes, or less where none is so small."""
MARKERS = ("o", "s", "^", "2", "D", "1", "v", "P", "X", "<", ">", "*")


def by_family(found: Mapping[str, Sequence[Point]], peers: Sequence[str]) -> dict[str, Callable[[], Figure]]:
    """By file name, functions that draw."""
    drawn: dict[str, Callable[[], Figure]] = {}
    for family, words in FAMILIES.items():
        of_family = {title: found[title] for title in found if title.startswith(family)}
        if of_family:
            drawn[f"peers_{family.lower()}"] = partial(draw, of_family, peers, f"{words}: time to an error")
    return drawn


def draw(
    found: Mapping[str, Sequence[Point]], peers: Sequence[str], title: str, ours: tuple[str, ...] = ("vmri_jax",)
) -> Figure:
    """One panel per case; peers whose names begin as `ours` are in front."""
    with plots.new_figure(max(7.2, 0.7 + 3.4 * len(found)), 4.7, title, plots.LIGHT) as figure:
        panels = figure.subplots(1, len(found), squeeze=False, sharey=True)[0]
        lowest = min((p.settled for points in found.values() for p in points), default=SHOWN[0])
        for axes, (name, points) in zip(panels, found.items(), strict=True):
            _panel(axes, points, peers, ours)
            axes.set(title=name, xlabel="time, s", ylim=(max(SHOWN[0], lowest / 3), SHOWN[1]))
        panels[0].set(ylabel=r"error $\max\,|q - q_{\mathrm{ref}}|$ at the end")
        legend_below(figure)
    return figure


def _panel(axes: Axes, points: Sequence[Point], peers: Sequence[str], ours: tuple[str, ...]) -> None:
    theme = plots.LIGHT
    for level in LEVELS:
        axes.axhline(level, color=theme.faint, linewidth=1.0, linestyle=(0, (4, 2)), zorder=0)
    for i, peer in reversed(list(enumerate(peers))):
        shown = [p for p in front([p for p in points if p.peer == peer]) if p.settled < 1.0]
        if not shown:
            continue
        x, y = [p.seconds for p in shown], [max(p.settled, SHOWN[0] / 10) for p in shown]
        look = {"color": COLORS[i % len(COLORS)], "marker": MARKERS[i % len(MARKERS)], "label": peer}
        strong = {"linewidth": 2.8, "markersize": 5.5, "zorder": 5}
        weak = {"linewidth": 1.1, "markersize": 3.6, "zorder": 3, "alpha": 0.9}
        axes.loglog(x, y, **look, **(strong if peer.startswith(ours) else weak))
    left, right = axes.get_xlim()
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0,) if right > 100 * left else (1.0, 3.0), numticks=12))
    axes.xaxis.set_major_formatter(LogFormatterSciNotation(labelOnlyBase=False, minor_thresholds=(9, 9)))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(axis="y", visible=False)
    axes.set_yticks(LEVELS, [_power(level) for level in LEVELS])
    axes.minorticks_off()


def _power(level: float) -> str:
    mantissa, _, exponent = f"{level:.0e}".partition("e")
    power = rf"10^{{{int(exponent)}}}"
    return f"${power}$" if mantissa == "1" else rf"${mantissa}\cdot{power}$"

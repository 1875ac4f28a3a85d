"""The one style of all figures: themes, figures, legends, ticks."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter


@dataclass(frozen=True)
class Theme:
    """Colours of a figure: paper, text, faint lines, rods of animations, and the cycle of the curves."""

    paper: str
    ink: str
    faint: str
    rod: str
    curves: tuple[str, ...]


LIGHT = Theme(
    "#ffffff", "#1f2428", "#d9dde1", "#8d979f", ("#0072b2", "#d55e00", "#009e73", "#a3508a", "#b98700", "#3d8fc4")
)
DARK = Theme(
    "#15191d", "#e3e6e8", "#384048", "#8b969f", ("#62b5e8", "#f08a4b", "#3cc79b", "#dd92c4", "#e3b341", "#9ad0f0")
)
MARKERS = ("o", "s", "^", "D", "v", "P")
LINES = ("-", "--", ":", "-.", (0, (7, 1.5, 1, 1.5, 1, 1.5)))
"""Styles of lines: the style changes after each pass through the colours, so that 30 curves differ."""
ROUNDOFF_FLOOR = 1e-17
"""Value at which a logarithmic axis of residuals draws zeros, below round-off; a smaller one stretches the axis."""
DPI = 150
"""Dots per inch of a figure saved by its method `savefig` outside of `style`; a larger value makes larger files."""

LEGEND_SIZE = 9.0
"""Size of the letters of a legend, in points."""


class NotebookFigure(Figure):
    """A figure that notebooks show without pyplot and its global state."""

    def _repr_png_(self) -> bytes:
        buffer = BytesIO()
        self.savefig(buffer, format="png", dpi=110)
        return buffer.getvalue()


def style(theme: Theme = LIGHT):
    """Context in which figures are made and saved: ``with style(theme): ...``.

    Args:
        theme: colours.
    """
    return matplotlib.rc_context(
        {
            "figure.facecolor": theme.paper,
            "savefig.facecolor": theme.paper,
            "savefig.dpi": 200,
            "figure.constrained_layout.use": True,
            "font.family": "sans-serif",
            "font.size": 9.5,
            "mathtext.fontset": "dejavusans",
            "axes.facecolor": theme.paper,
            "axes.edgecolor": theme.ink,
            "axes.labelcolor": theme.ink,
            "axes.linewidth": 0.7,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "axes.titlesize": 10.5,
            "axes.titlecolor": theme.ink,
            "axes.titlelocation": "left",
            "axes.prop_cycle": matplotlib.cycler(color=theme.curves),  # pyright: ignore[reportAttributeAccessIssue]
            "axes.grid": True,
            "axes.axisbelow": True,
            "grid.color": theme.faint,
            "grid.linewidth": 0.6,
            "text.color": theme.ink,
            "xtick.color": theme.ink,
            "ytick.color": theme.ink,
            "xtick.major.width": 0.7,
            "ytick.major.width": 0.7,
            "lines.linewidth": 1.3,
            "lines.markersize": 5.0,
            "legend.frameon": False,
            "legend.fontsize": LEGEND_SIZE,
            "svg.fonttype": "path",
            "svg.hashsalt": "vmri_jax",
        }
    )


@contextmanager
def new_figure(width: float, height: float, title: str, theme: Theme) -> Iterator[NotebookFigure]:
    """A figure to fill within the context, in its style; the title is set at the end.

    Args:
        width, height: size in inches.
        title: title above the panels.
        theme: colours.
    """
    with style(theme):
        figure = NotebookFigure(figsize=(width, height), dpi=DPI)
        yield figure
        figure.suptitle(title, x=0.01, ha="left")


def panel_grid(figure: Figure, count: int, columns: int, xlabel: str = "", ylabel: str = "") -> np.ndarray:
    """`count` axes in rows of `columns`; the cells left over in the last row stay empty.

    Args:
        figure: figure to draw on.
        count: number of panels.
        columns: columns of the grid.
        xlabel, ylabel: labels of the lowest axes, and of the axes of the first column.
    """
    axes = figure.subplots(math.ceil(count / columns), columns, squeeze=False).reshape(-1)
    for empty in axes[count:]:
        empty.set_axis_off()
    for lowest in axes[:count][-columns:]:
        lowest.set(xlabel=xlabel)
    for first in axes[:count:columns]:
        first.set(ylabel=ylabel)
    return axes[:count]


def save(figure: Figure, path, theme: Theme = LIGHT) -> None:
    """Write a figure in the format that the suffix of the path names.

    Args:
        figure: a figure of any function of this package.
        path: path of the file.
        theme: the colours of the figure.

    Raises:
        OSError: the file cannot be written.
        ValueError: matplotlib does not know the suffix.
    """
    with style(theme):
        figure.savefig(path)


def curve_look(i: int, theme: Theme) -> dict[str, Any]:
    """Colour, marker and line style of curve i, as keywords of ``plot``; no two of the first 30 curves look alike.

    Args:
        i: number of the curve.
        theme: colours.
    """
    turn, color = divmod(i, len(theme.curves))
    return {
        "color": theme.curves[color],
        "marker": MARKERS[(color + turn) % len(MARKERS)],
        "markerfacecolor": theme.paper,
        "linestyle": LINES[turn % len(LINES)],
    }


def legend_below(figure: Figure) -> None:
    """Names of all curves under the panels, each name once, in as many columns as fit.

    The figure grows by the height of the legend, so that the panels keep their height.

    Args:
        figure: a figure with its panels drawn.
    """
    curves: dict[str, Any] = {}
    for axes in figure.axes:
        handles, labels = axes.get_legend_handles_labels()
        curves = dict(zip(labels, handles, strict=True)) | curves
    if not curves:
        return
    (width, height), size = figure.get_size_inches(), LEGEND_SIZE
    # Inches of a column: 4 letters for the line before the name, and 0.56 of the size for a letter of the name.
    column = size / 72 * (4 + 0.56 * max(map(len, curves)))
    columns = max(1, min(len(curves), int(width / column)))
    rows = math.ceil(len(curves) / columns)
    figure.set_size_inches(width, height + 0.1 + 1.35 * size / 72 * rows)
    look = {"fontsize": size, "handlelength": 2.6, "labelspacing": 0.3, "columnspacing": 1.5}
    figure.legend(curves.values(), curves.keys(), loc="outside lower left", ncols=columns, **look)


def legend_beside(axes: Axes, title: str | None = None, size: float = LEGEND_SIZE) -> None:
    """Names of the curves to the right of a panel, in letters of `size` points."""
    look = {"handlelength": 1.2, "fontsize": size, "title_fontsize": size, "labelspacing": 0.3}
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), title=title, **look)


def positive(values: Any) -> np.ndarray:
    """Values for a logarithmic axis: values that are not positive become NaN, which is not drawn."""
    values = np.asarray(values, dtype=float)
    return np.where(values > 0, values, np.nan)


def log_ticks(axis: Axis, values: Sequence[float] | np.ndarray) -> None:
    """Make an axis logarithmic, with labels at powers of ten; or at 1, 2, 5 times powers of ten if the values span less
    than a factor of 30.

    Args:
        axis: an axis of a panel with or without curves.
        values: numbers drawn along the axis.
    """
    # A panel without curves is still linear, and logarithmic ticks refuse its limits 0 and 1.
    if axis.get_scale() != "log":
        (axis.axes.set_xscale if axis is axis.axes.xaxis else axis.axes.set_yscale)("log")
    finite = [value for value in values if np.isfinite(value) and value > 0]
    axis.set_minor_formatter(NullFormatter())
    powers = math.floor(math.log10(max(finite))) - math.ceil(math.log10(min(finite))) + 1 if finite else 2
    if finite and (powers < 2 or max(finite) < 30 * min(finite)):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter("{x:g}")

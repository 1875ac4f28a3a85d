"""Figures of ensembles: responses over one or two parameters, distributions, trajectories with bands."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, LogNorm, Normalize

from vmri_jax.mechanics.names import unknown
from vmri_jax.plots.theme import (
    LIGHT,
    NotebookFigure,
    Theme,
    legend_below,
    legend_beside,
    log_ticks,
    new_figure,
    panel_grid,
)
from vmri_jax.refusals import Refused
from vmri_jax.steppers.results import Result

if TYPE_CHECKING:
    import xarray

COORDINATES = ("slow", "fast", "level", "quantile", "node")
"""Dimensions of the results of a single run; all other dimensions are parameters."""
STATUS = ("result", "failed_at")
BANDS = (0.05, 0.25, 0.5, 0.75, 0.95)
"""Quantiles that are drawn: a band of nine tenths of the runs, a band of half of them, and the median."""
MOST_CURVES = 6
"""Most curves of a figure over one axis, the number of colours; more are drawn as bands."""
MOST_PANELS = 12
"""Most panels of a figure; more are refused, since they would be too small to read."""
LOGARITHMIC_RATIO = 30.0
"""Ratio of the largest to the smallest positive value above which an axis or a colour scale is logarithmic."""


def plot_ensemble(
    data: "xarray.Dataset",
    quantity: str | None = None,
    x: str | None = None,
    y: str | None = None,
    *,
    title: str = "",
    theme: Theme = LIGHT,
) -> NotebookFigure:
    """A result of an ensemble over its parameters.

    The figure over two axes is a map in colours, with a panel for each value of a third and a fourth axis; failed runs
    are grey. The figure over one axis has curves, or bands if there are more than six curves. Over a column of a table
    or of random draws it is a scatter plot, and without parameters a histogram. A quantity of all saved nodes is drawn
    against time, with the bands that hold half and nine tenths of the runs that did not fail.

    Args:
        data: from `vmri_jax.open_ensemble`, or a selection of it.
        quantity: name of the result; if None the last one with a single number per run, or per saved node.
        x, y: names of axes or columns; the two longest axes if both are None and the design has axes.
        title: title above the panels.
        theme: colours.

    Raises:
        ValueError: an unknown name, a quantity with several numbers per run, no quantity to choose, or too many panels.
    """
    quantity = _quantity(data, quantity)
    values = data[quantity]
    if "node" in values.dims:
        return _plot_bands(data, values.where(~_failed(data, values)), title, theme)
    several = [name for name in values.dims if name in COORDINATES]
    if several:
        one = f"data.isel({several[0]}=0) or data.sel({several[0]}={data[several[0]].values[0]!r})"
        raise Refused(f"plot_ensemble: {quantity} has several numbers per run; choose one, {one}.")
    for name in (x, y):
        if name is not None and name not in data.coords:
            raise Refused(f"plot_ensemble: {unknown('axis or column', name, map(str, data.coords))}")
    values = values.compute()
    axes = sorted((str(d) for d in values.dims if d != "lane"), key=lambda d: -values.sizes[d])
    if x is None and y is None and "lane" not in values.dims:
        numbers = [name for name in axes if values[name].dtype.kind in "if" and values.sizes[name] > 1]
        x, y = [*numbers[:2], None, None][:2]
    if x is None:
        return _plot_histogram(values, title, theme)
    if "lane" in values.dims:
        return _plot_cloud(values, x, y, title, theme)
    if y is None:
        return _plot_curves(values, x, title, theme)
    return _plot_maps(values, _failed(data, values), x, y, title, theme)


def _failed(data: "xarray.Dataset", values):
    """Whether a run failed, for every run."""
    return data.result > int(Result.CONVERGED_AT_ROUNDOFF) if "result" in data else values.isnull()


def _quantity(data: "xarray.Dataset", name: str | None) -> str:
    """The name of the quantity to draw, see `plot_ensemble`."""
    if name is not None:
        if name not in data:
            raise Refused(f"plot_ensemble: {unknown('quantity', name, map(str, data.data_vars))}")
        return name
    arrays = {str(n): set(map(str, array.dims)) & set(COORDINATES) for n, array in data.data_vars.items()}
    arrays = {n: several for n, several in arrays.items() if n not in (*STATUS, "node_t")}
    for several in (set(), {"node"}):
        names = [n for n, dimensions in arrays.items() if dimensions == several]
        if names:
            return names[-1]
    kept = ", ".join(arrays) or "none besides the status, which is drawn as 'result'"
    raise Refused(
        f"plot_ensemble: no quantity is one number per run; there are {kept}. Save one, save=('end', 'energy_error'), "
        "or choose one number of a quantity: plot_ensemble(data.isel(slow=0), 'q_s')."
    )


def _label(array) -> str:
    unit = array.attrs.get("units")
    return f"{array.name}" + (f" in {unit}" if unit else "")


def _panels(values, drawn: Sequence[str]) -> list[tuple[str, Any]]:
    """For each combination of values of the axes that are not drawn: a title with these values, and the array."""
    panel_axes = [d for d in values.dims if d not in drawn]
    count = int(np.prod([values.sizes[d] for d in panel_axes], dtype=int))
    if count > MOST_PANELS:
        others = f"{', '.join(map(str, panel_axes))} with {count} combinations of values"
        raise Refused(f"plot_ensemble: besides {', '.join(drawn)} there are {others}; data.sel() selects some.")
    panels = []
    for numbers in np.ndindex(*(values.sizes[d] for d in panel_axes)):
        indices = dict(zip(panel_axes, numbers, strict=True))
        title = "\n".join(_named(d, values[d].values[i]) for d, i in indices.items())
        panels.append((title, values.isel(indices)))
    return panels


def _named(axis: str, value) -> str:
    """A value with the name of its axis; a value that is a string stands alone."""
    if isinstance(value, str):
        return value
    return f"{axis} = {value:.4g}" if isinstance(value, float | np.floating) else f"{axis} = {value}"


def _plot_maps(values, failed, x: str, y: str, title: str, theme: Theme) -> NotebookFigure:
    failed = failed.compute()
    panels, marks = _panels(values, (x, y)), [panel for _, panel in _panels(failed, (x, y))]
    norm = _norm(values.values)
    columns = min(4, len(panels))
    rows = -(-len(panels) // columns)
    with new_figure(1.2 + 2.6 * columns, 0.9 + 2.3 * rows, title, theme) as figure:
        grid = panel_grid(figure, len(panels), columns, _label(values[x]), _label(values[y]))
        for axes, (name, panel), mark in zip(grid, panels, marks, strict=True):
            colours = {"norm": norm, "cmap": "viridis", "rasterized": True}
            mesh = axes.pcolormesh(values[x], values[y], panel.transpose(y, x), **colours)
            hidden = np.ma.masked_where(~mark.transpose(y, x).values, np.ones((values.sizes[y], values.sizes[x])))
            axes.pcolormesh(values[x], values[y], hidden, cmap=ListedColormap([theme.faint]), rasterized=True)
            axes.set_title(name)
            axes.grid(visible=False)
            _scale(axes, values[x], values[y])
        bar = figure.colorbar(mesh, ax=list(grid), label=_label(values), pad=0.02)
        bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
        if failed.any():
            figure.text(0.99, 0.005, "grey: runs that failed", ha="right", va="bottom", fontsize=8)
    return figure


def _plot_curves(values, x: str, title: str, theme: Theme) -> NotebookFigure:
    curve_axes = [d for d in values.dims if d != x]
    with new_figure(7.0, 3.8, title, theme) as figure:
        axes = figure.subplots()
        if int(np.prod([values.sizes[d] for d in curve_axes], dtype=int)) <= MOST_CURVES:
            for name, curve in _panels(values, (x,)):
                axes.plot(values[x], curve, label=name.replace("\n", ", ") or None)
            if curve_axes:
                legend_beside(axes)
        else:
            _fill_bands(axes, values[x].values, values.quantile(BANDS, dim=curve_axes, skipna=True).values, theme)
            legend_beside(axes)
        _scale(axes, values[x], values)
        axes.set(xlabel=_label(values[x]), ylabel=_label(values))
    return figure


def _plot_cloud(values, x: str, y: str | None, title: str, theme: Theme) -> NotebookFigure:
    up = values if y is None else values[y]
    with new_figure(6.0, 3.9, title, theme) as figure:
        axes = figure.subplots()
        size = float(np.clip(3e4 / max(len(values), 1), 0.5, 20.0))
        alike, by_value = {"color": theme.curves[0], "alpha": 0.6}, {"c": values, "norm": _norm(values.values)}
        look: dict[str, Any] = {"s": size, "linewidths": 0, "rasterized": True} | (alike if y is None else by_value)
        points = axes.scatter(values[x].values, up.values, **look)
        if y is not None:
            figure.colorbar(points, ax=axes, label=_label(values))
        axes.set(xlabel=_label(values[x]), ylabel=_label(up))
        _scale(axes, values[x], up)
    return figure


def _plot_histogram(values, title: str, theme: Theme) -> NotebookFigure:
    numbers = np.asarray(values).ravel()
    numbers = numbers[np.isfinite(numbers)]
    with new_figure(6.0, 3.6, title, theme) as figure:
        axes = figure.subplots()
        logarithmic = numbers.size > 0 and _is_wide(numbers)
        bins = np.geomspace(numbers.min(), numbers.max(), 61) if logarithmic else 60
        axes.hist(numbers, bins=bins, color=theme.curves[0])
        axes.set(xlabel=_label(values), ylabel="runs")
        if logarithmic:
            log_ticks(axes.xaxis, numbers)
    return figure


def _plot_bands(data, values, title: str, theme: Theme) -> NotebookFigure:
    """Median and bands of all runs against time, a panel for each coordinate."""
    runs = [d for d in values.dims if d not in COORDINATES]
    has_coordinates = any(d in COORDINATES and d != "node" for d in values.dims)
    time = data.node_t.mean(runs, skipna=True).values if "node_t" in data else np.arange(values.sizes["node"])
    if runs:
        bands = values.chunk(dict.fromkeys(runs, -1)).quantile(BANDS, dim=runs, skipna=True).compute()
    else:
        bands = values.expand_dims(quantile=len(BANDS)).compute()
    panels = _panels(bands, ("quantile", "node"))
    columns = min(3, len(panels))
    with new_figure(0.8 + 3.0 * columns, 0.8 + 2.2 * -(-len(panels) // columns), title, theme) as figure:
        grid = panel_grid(figure, len(panels), columns, "time")
        for axes, (name, panel) in zip(grid, panels, strict=True):
            _fill_bands(axes, time, panel.transpose("quantile", "node").values, theme)
            axes.set_title(name if has_coordinates else _label(values))
        legend_below(figure)
    return figure


def _fill_bands(axes: Axes, along: np.ndarray, bands: np.ndarray, theme: Theme) -> None:
    lowest, low, middle, high, highest = bands
    colour = theme.curves[0]
    axes.fill_between(along, lowest, highest, color=colour, alpha=0.18, linewidth=0, label="nine tenths of the runs")
    axes.fill_between(along, low, high, color=colour, alpha=0.32, linewidth=0, label="half of them")
    axes.plot(along, middle, color=colour, label="median")


def _is_wide(values: np.ndarray) -> bool:
    finite = values[np.isfinite(values)]
    return finite.size > 0 and finite.min() > 0 and finite.max() > LOGARITHMIC_RATIO * finite.min()


def _norm(values: np.ndarray) -> Normalize:
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return Normalize(0.0, 1.0)
    positive = finite[finite > 0]
    if positive.size and finite.min() >= 0 and positive.max() > LOGARITHMIC_RATIO * np.quantile(positive, 0.02):
        return LogNorm(np.quantile(positive, 0.02), np.quantile(positive, 0.98), clip=True)
    return Normalize(finite.min(), finite.max())


def _scale(axes: Axes, x, y) -> None:
    """Make an axis logarithmic if its values are positive and span more than `LOGARITHMIC_RATIO`."""
    for values, axis in ((np.ravel(x), axes.xaxis), (np.ravel(y), axes.yaxis)):
        if _is_wide(values):
            log_ticks(axis, values)

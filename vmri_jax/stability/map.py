"""Stability maps and figures: the stable macro steps of a scheme, over ``omega H`` and over schemes or systems."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, LogNorm

from vmri_jax.executors.executor import mapped
from vmri_jax.mechanics.arrays import real_array
from vmri_jax.mechanics.linearisation import Linearisation, linearise
from vmri_jax.mechanics.state import Movable, State, start_of
from vmri_jax.plots import LIGHT, NotebookFigure, Theme, new_figure, panel_grid
from vmri_jax.refusals import Refused
from vmri_jax.schemes.composition import SchemeLike
from vmri_jax.stability.multipliers import multipliers
from vmri_jax.study.table import Column, ResultTable

POINTS_IN_WINDOW = np.linspace(0.0, 1.0, 9)
"""Points of a window at which its growth is measured, in widths from its start."""
RESOLUTION = 1e-7
"""Accuracy of the ends of windows, as a part of the range of omega H; narrower windows are left out."""
POINTS_PER_CALL = 64
"""Samples that all brackets together get in a call of `label`, the number that `multipliers` computes at a time for
small systems; more samples divide brackets faster, and each costs an eigenvalue problem."""
GROWTHS_SHOWN = (1e-6, 1.0)
"""Growth per step of the faintest and of the full colour."""
MOST_COLUMNS = 3
"""Most panels in a row."""


class Window(NamedTuple):
    """An interval of unstable steps, and the largest growth per step measured in it."""

    start: float
    stop: float
    growth: float


def windows_text(windows: Sequence[Window]) -> str:
    """Windows of omega H in units of pi."""
    return ", ".join(f"{w.start / np.pi:.4g} to {w.stop / np.pi:.4g}" for w in windows) or "nowhere"


@dataclass(frozen=True, repr=False)
class StabilityMap(ResultTable):
    """Largest multipliers of a macro step over a grid, and the windows of instability.

    axis: "scheme" or "system", the meaning of the rows.
    rows: (m,) labels of the rows.
    omega: frequency that scales the grid, the largest frequency of the fast potential alone.
    omega_H: (n,) grid, macro step times omega.
    radius: (m, n) spectral radius of the derivative of the step, without the multipliers of motions of the system that
        grow; infinite where the step failed.
    unstable: the windows of omega_H of each row in which radius > 1 + 1e-6; they may be far narrower than the grid.
    note: why the map does not tell whether the motion is stable, see `Linearisation.frozen`; empty at an equilibrium.
    """

    columns = (
        Column("row", lambda row: str(row[0])),
        Column("unstable where omega H / pi is in", lambda row: windows_text(row[1])),
    )
    axis: str
    rows: tuple
    omega: float
    omega_H: np.ndarray
    radius: np.ndarray
    unstable: tuple[tuple[Window, ...], ...]
    note: str = ""

    caption = property(lambda self: self.note, doc="The note.")

    @property
    def macro_dt(self) -> np.ndarray:
        """(n,) macro steps."""
        return self.omega_H / self.omega

    def windows(self, row=None) -> list[Window]:
        """Intervals of omega H that are unstable, for one row (the first by default)."""
        row = self.rows[0] if row is None else row
        if row not in self.rows:
            raise Refused(f"windows: there is no row {row!r}; there are {', '.join(map(repr, self.rows))}.")
        return list(self.unstable[self.rows.index(row)])

    def first_unstable(self, row=None) -> float:
        """Smallest unstable omega H of one row (the first by default); infinite where there is none on the grid."""
        return next((window.start for window in self.windows(row)), np.inf)

    def shown(self) -> list[tuple[Any, list[Window]]]:
        """The label of every row and its windows."""
        return list(zip(self.rows, map(list, self.unstable), strict=True))

    def records(self) -> list[dict[str, Any]]:
        """A record for each row and grid point."""
        return [
            {self.axis: label, "omega_H": float(x), "macro_dt": float(dt), "radius": float(value)}
            for label, radius in zip(self.rows, self.radius, strict=True)
            for x, dt, value in zip(self.omega_H, self.macro_dt, radius, strict=True)
        ]


def stability_map(
    system: Movable | Mapping[Any, Movable],
    scheme: SchemeLike | Mapping[Any, SchemeLike],
    omega_H: Sequence[float] | np.ndarray,
    *,
    state: State | None = None,
    executor: Any = None,
) -> StabilityMap:
    """Stability of macro steps of length H, from the multipliers of the step of small motions about a state.

    At an equilibrium these are the eigenvalues of the derivative of `macro_step`; elsewhere the eigenvalues for the
    frozen problem (see `linearise`). Multipliers of opposite Krein signature that have passed each other between two
    grid points reveal a window there, whose ends are refined by bisection.

    Args:
        system: `linear_model()`, any other problem or scene, a system with a state, or several by label for a single
            scheme, e.g. ``{k: linear_model(kappa=k) for k in (5.0, 25.0)}``. The unit of the grid is omega of the
            first: the largest frequency of its fast potential alone, or the largest rate of all motions if this
            potential has no frequency.
        scheme: a scheme or composition, or several by label, e.g. ``{n: explicit_slow(n) for n in (2, 3, 5)}``; each
            num_micro and structure is compiled once.
        omega_H: (n,) increasing positive values of omega times the macro step. A spacing of 0.1 or less finds narrow
            windows; with a larger one multipliers that pass several others hide windows.
        state: point of expansion of the small motions; None for the start of the problem.
        executor: executor that computes the rows, as of `vmri_jax.ensemble`; None for this process.

    Raises:
        TypeError: a system or scheme of the wrong kind.
        ValueError: a grid that is not increasing and positive; several systems with several schemes.
    """
    grid = np.asarray(real_array("stability_map: omega_H", omega_H))
    if grid.ndim != 1 or grid.size < 2 or not (np.isfinite(grid).all() and grid[0] > 0 and (np.diff(grid) > 0).all()):
        values = f"{grid.flat[0]:g} to {grid.flat[-1]:g}" if grid.size else "none"
        expected = "give two or more positive values, increasing, e.g. numpy.linspace(0.05, 12, 240)"
        raise Refused(f"stability_map: omega_H has shape {grid.shape} and values {values}; {expected}.")
    systems = system if isinstance(system, Mapping) else {"": system}
    schemes = scheme if isinstance(scheme, Mapping) else {"": scheme}
    if not schemes or not all(isinstance(s, SchemeLike) for s in schemes.values()):
        raise Refused(f"stability_map: scheme is {scheme!r}; give a Scheme, e.g. explicit_slow(10), or a dict of them.")
    if min(len(systems), len(schemes)) != 1:
        raise Refused(f"stability_map: {len(systems)} systems and {len(schemes)} schemes; give one of either.")
    axis, labels = ("system", systems) if isinstance(system, Mapping) and len(schemes) == 1 else ("scheme", schemes)
    linear = [linearise(*start_of("stability_map", movable, state)) for movable in systems.values()]
    rows = dict(zip(labels, product(linear, schemes.values()), strict=True))
    omega = float(linear[0].frequencies_of("fast").max(initial=0.0) or np.abs(linear[0].rates).max(initial=0.0))
    if omega == 0:
        raise Refused("stability_map: the system has no frequency that could scale omega_H; nothing vibrates there.")
    measured = mapped("stability_map", measure, [(*row, grid / omega) for row in rows.values()], executor)
    return StabilityMap(
        axis=axis,
        rows=tuple(rows),
        omega=omega,
        omega_H=grid,
        radius=np.array([radius for radius, _ in measured]),
        unstable=tuple(tuple(Window(omega * a, omega * b, g) for a, b, g in windows) for _, windows in measured),
        note=linear[0].frozen,
    )


def measure(
    linear: Linearisation, scheme: SchemeLike, macro_dt, resolution: float = RESOLUTION
) -> tuple[np.ndarray, list[Window]]:
    """Spectral radius (n,) at n increasing macro steps, and the unstable windows between the first and the last."""

    def label(macro_dt):
        return multipliers(linear, scheme, macro_dt).krein_signatures

    spectra = multipliers(linear, scheme, macro_dt)
    edges = find_windows(label, macro_dt, spectra.krein_signatures, resolution * (macro_dt[-1] - macro_dt[0]))
    if not edges:
        return spectra.radius, []
    inside = np.array([a + (b - a) * POINTS_IN_WINDOW for a, b in edges])
    peaks = multipliers(linear, scheme, inside.reshape(-1)).radius.reshape(inside.shape).max(axis=1) - 1
    return spectra.radius, [Window(*ends, float(peak)) for ends, peak in zip(edges, peaks, strict=True)]


def find_windows(
    label: Callable[[np.ndarray], Sequence], x: np.ndarray, labels: Sequence, resolution: float
) -> list[tuple[float, float]]:
    """Unstable intervals of x between its first and last value; ``label(samples)`` has a label for each sample, None
    for unstable, else any value to compare, and `labels` are those of x (k,).

    Between neighbouring samples with different labels lies an end of a window, or a whole window. All such brackets are
    divided at the same time, until they are shorter than `resolution`; shorter windows are left out.
    """
    edges = [x[0]] if labels[0] is None else []
    samples = zip(x, x[1:], labels, labels[1:], strict=False)
    brackets = [(a, b, label_a, label_b) for a, b, label_a, label_b in samples if label_a != label_b]
    while brackets:
        count = max(1, POINTS_PER_CALL // len(brackets))
        fractions = np.arange(1, count + 1) / (count + 1)
        inner = np.array([a + (b - a) * fractions for a, b, _, _ in brackets])
        inner_labels = iter(label(inner.reshape(-1)))
        divided = []
        for (a, b, label_a, label_b), points in zip(brackets, inner, strict=True):
            nodes = [a, *points, b]
            node_labels = [label_a, *(next(inner_labels) for _ in points), label_b]
            pieces = zip(nodes, nodes[1:], node_labels, node_labels[1:], strict=False)
            divided += [piece for piece in pieces if piece[2] != piece[3]]
        brackets = [piece for piece in divided if piece[1] - piece[0] > resolution]
        # Of a short bracket with an unstable side, the stable end: the window includes the bracket. Two different
        # stable labels hide a window shorter than the resolution.
        for a, b, label_a, label_b in divided:
            if b - a <= resolution and None in (label_a, label_b):
                edges.append(a if label_b is None else b)
    if labels[-1] is None:
        edges.append(x[-1])
    edges = [float(edge) for edge in sorted(edges)]
    return list(zip(edges[::2], edges[1::2], strict=True))


def plot_stability(maps: Mapping[str, StabilityMap], title: str = "", theme: Theme = LIGHT) -> NotebookFigure:
    """Unstable windows over ``omega H / pi`` and the rows of each map, one panel per map.

    The colour of a window is its largest growth per step. Rows are stacked from the bottom: systems with numbers as
    labels at these heights, all others in their order.

    Args:
        maps: maps by the title of their panel, e.g. one per scheme, each over num_micro or systems.
        title: title above the panels.
        theme: colours.
    """
    columns = min(MOST_COLUMNS, len(maps))
    height = float(np.clip(0.9 + 0.17 * max(len(m.rows) for m in maps.values()), 1.6, 3.2))
    shades = LinearSegmentedColormap.from_list("growth", [theme.curves[4], theme.curves[1], theme.ink])
    colors = ScalarMappable(LogNorm(*GROWTHS_SHOWN, clip=True), shades)
    size = max(5.2, 0.9 + 2.9 * columns), 0.9 + height * math.ceil(len(maps) / columns)
    with new_figure(*size, title, theme) as figure:
        panels = panel_grid(figure, len(maps), columns, r"$\omega H / \pi$")
        for axes, (name, stability) in zip(panels, maps.items(), strict=True):
            over_numbers = stability.axis == "system" and all(isinstance(row, float) for row in stability.rows)
            y = np.array(stability.rows, dtype=float) if over_numbers else np.arange(len(stability.rows))
            edges = _cells(y)
            for windows, bottom, top in zip(stability.unstable, edges, edges[1:], strict=False):
                shade = colors.to_rgba(np.array([window.growth for window in windows]))
                spans = [(w.start / np.pi, (w.stop - w.start) / np.pi) for w in windows]
                axes.broken_barh(spans, (bottom, top - bottom), facecolors=shade, edgecolors=shade, linewidth=0.7)
            axes.set(title=name, xlim=(0, stability.omega_H[-1] / np.pi), ylim=(edges[0], edges[-1]))
            if not over_numbers:
                axes.set_yticks(y, [str(row) for row in stability.rows])
                axes.grid(axis="y", visible=False)
            if all(isinstance(row, int) for row in stability.rows):
                axes.set(ylabel="micro steps per macro step")
        figure.colorbar(colors, ax=panels.tolist(), label="growth per macro step\n(blank: stable)", aspect=30, pad=0.01)
    return figure


def _cells(centres) -> np.ndarray:
    """(k + 1,) edges of cells around k increasing centres, halfway between neighbours."""
    if len(centres) == 1:
        return centres[0] + np.array([-0.5, 0.5])
    middle = (centres[1:] + centres[:-1]) / 2
    return np.concatenate([[2 * centres[0] - middle[0]], middle, [2 * centres[-1] - middle[-1]]])

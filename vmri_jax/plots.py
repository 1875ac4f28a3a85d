"""Figures in one style: trajectories, conserved quantities, convergence and computing time.

Every function returns a matplotlib `Figure` made without pyplot: no window opens, no global setting is touched, and a
notebook shows it when it is the value of a cell. Colours follow Okabe and Ito, told apart by the colour-blind.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from typing import Any, Protocol

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, FixedLocator, LogLocator, NullFormatter, NullLocator

from vmri_jax.mechanics.invariants import oscillatory_energies
from vmri_jax.mechanics.names import Names


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
DPI = 150
"""Of figures that are saved by their own method."""
MOST_NAMED = 12
"""Of more curves than this in one panel so many are named."""
ROUNDOFF = 1e-13
"""Axes span this part of the values at least."""


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
            "legend.fontsize": 9,
            "svg.fonttype": "path",
            "svg.hashsalt": "vmri_jax",
        }
    )


@contextmanager
def new_figure(width: float, height: float, title: str, theme: Theme) -> Iterator[NotebookFigure]:
    """A figure to fill within the context, in its style; the title is set at the end.

    Args:
        width, height: in inches.
        title: over the figure.
        theme: colours.
    """
    with style(theme):
        figure = NotebookFigure(figsize=(width, height), dpi=DPI)
        yield figure
        figure.suptitle(title, x=0.01, ha="left")


def panel_grid(figure: Figure, count: int, columns: int) -> np.ndarray:
    """So many axes in rows of `columns`; cells of the grid that are left over stay empty.

    Args:
        figure: to draw on.
        count: number of panels.
        columns: of the grid.
    """
    axes = figure.subplots(math.ceil(count / columns), columns, squeeze=False).reshape(-1)
    for empty in axes[count:]:
        empty.set_axis_off()
    return axes[:count]


def save(figure: Figure, path, theme: Theme = LIGHT) -> None:
    """Write a figure in the format of the file's ending.

    Args:
        figure: of any function here.
        path: of the file.
        theme: the colours that the figure was made in.

    Raises:
        OSError: the file cannot be written.
        ValueError: an ending that matplotlib does not know.
    """
    with style(theme):
        figure.savefig(path)


class Run(Protocol):
    """Saved nodes of a run, (k,) and (k, n), and what is known of it, see `vmri_jax.Trajectory`."""

    t: Any
    q_s: Any
    q_f: Any
    p_f: Any
    energy: Any
    constraint_residual: Any

    @property
    def names(self) -> Names: ...
    @property
    def keeps_energy(self) -> bool | None: ...
    def work(self) -> Any: ...


def plot_trajectory(trajectory: Run, title: str = "", theme: Theme = LIGHT) -> NotebookFigure:
    """Slow and fast positions, energy and, where there are constraints, their residual, against time.

    The energy of a system that keeps it is shown as an error. Of one with forces or moving constraints the figure shows its
    change, their work, and what is left of the balance.

    Args:
        trajectory: a run; nodes after a failure are left out by matplotlib since they are NaN.
        title: over the figure.
        theme: colours.

    Raises:
        ValueError: a batch of runs.
    """
    if np.ndim(trajectory.t) != 1:
        raise ValueError("plot: this is a batch of runs; take one of them, run.lane(i).")
    t, names = np.asarray(trajectory.t), trajectory.names
    residual = np.asarray(trajectory.constraint_residual)
    constrained = bool(np.nanmax(residual) > 0)
    positions = [
        (np.asarray(trajectory.q_s), names.slow_coordinates, r"slow positions $q_s$"),
        (np.asarray(trajectory.q_f), names.fast_coordinates, r"fast positions $q_f$"),
    ]
    positions = [panel for panel in positions if panel[0].shape[1]]
    driven = trajectory.keeps_energy is False
    count = len(positions) + (2 if driven else 1) + constrained
    with new_figure(7.2, 0.4 + 1.85 * count, title, theme) as figure:
        axes = figure.subplots(count, sharex=True)
        for panel, (values, labels, what) in zip(axes, positions, strict=False):
            _coordinates(panel, t, values, labels, theme)
            panel.set_ylabel(what)
        if driven:
            _energy_balance(axes[len(positions)], axes[len(positions) + 1], trajectory, theme)
        else:
            _energy_error(axes[len(positions)], trajectory, theme)
        if constrained:
            shown = np.where(residual > 0, residual, np.nan)
            axes[-1].semilogy(t, shown[:, 0], "-", linewidth=_thin(t), label="position $|g|$")
            axes[-1].semilogy(t, shown[:, 1], "--", linewidth=_thin(t), label="velocity $|G v|$")
            axes[-1].set_ylabel("constraint residual")
            _legend_beside(axes[-1])
        axes[-1].set(xlabel="time $t$", xlim=(t[0], t[-1]))
        figure.align_ylabels()
    return figure


def plot_oscillatory_energies(trajectory: Run, omega, title: str = "", theme: Theme = LIGHT) -> NotebookFigure:
    """Energies ``I_i = (p_fi^2 + omega^2 q_fi^2) / 2`` of the stiff springs and their sum, the adiabatic invariant.

    Args:
        trajectory: a run of a system whose fast variables are oscillators of unit mass.
        omega: their frequency.
        title: over the figure.
        theme: colours.
    """
    t = np.asarray(trajectory.t)
    energies = np.asarray(oscillatory_energies(omega, trajectory.q_f, trajectory.p_f))
    with new_figure(7.2, 3.4, title, theme) as figure:
        axes = figure.subplots()
        axes.plot(t, energies.sum(axis=1), color=theme.ink, linewidth=1.0, label=r"$I = \sum I_i$")
        _coordinates(axes, t, energies, [f"$I_{{{i + 1}}}$" for i in range(energies.shape[1])], theme)
        axes.set(xlabel="time $t$", ylabel="oscillatory energy", xlim=(t[0], t[-1]))
        axes.set_ylim(bottom=0)
    return figure


class ConvergenceErrors(Protocol):
    """Errors by scheme and quantity, "q" or "p": macro steps and errors, those worth a fit, and the order they show."""

    @property
    def schemes(self) -> Sequence[str]: ...
    def errors(self, scheme: str, quantity: str) -> tuple[np.ndarray, np.ndarray]: ...
    def usable(self, scheme: str, quantity: str) -> tuple[np.ndarray, np.ndarray]: ...
    def order(self, scheme: str, quantity: str) -> float: ...


def plot_convergence(
    study: ConvergenceErrors, orders: Sequence[int] = (), title: str = "", theme: Theme = LIGHT
) -> NotebookFigure:
    """Errors of positions and of momenta against the macro step, with guide triangles of the given slopes.

    Args:
        study: e.g. of `vmri_jax.study.convergence_study`.
        orders: slopes to draw for comparison.
        title: over the figure.
        theme: colours.
    """
    with new_figure(7.6, 3.7, title, theme) as figure:
        panels = figure.subplots(1, 2, sharex=True)
        for axes, quantity, name in zip(panels, ("q", "p"), ("positions", "momenta"), strict=True):
            steps = []
            for i, scheme in enumerate(study.schemes):
                macro_dt, errors = study.errors(scheme, quantity)
                order = study.order(scheme, quantity)
                label = f"{scheme}   order {order:.2f}" if np.isfinite(order) else f"{scheme}   failed"
                axes.loglog(macro_dt, errors, label=label, **_look(i, theme))
                steps += list(macro_dt)
            for order in orders:
                _guide_triangle(axes, study, quantity, order, theme)
            axes.set(title=name, xlabel="macro step $H$")
            axes.set(ylabel=rf"largest error $|{quantity} - {quantity}_{{\mathrm{{ref}}}}|$")
            log_ticks(axes.xaxis, steps)
            axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=1, handlelength=2.4)
    return figure


WORK = {
    "seconds": "computing time of the run",
    "slow_evaluations": r"evaluations of $\nabla V$",
    "fast_evaluations": r"evaluations of $\nabla W$",
    "solves": "systems of equations solved",
}
"""What `plot_work_precision` has on its axis, by the name in the rows."""


class RunsByWork(Protocol):
    """Runs by scheme and the best of all: rows with `error_q`, `num_steps` and every kind of `WORK`."""

    @property
    def schemes(self) -> Sequence[str]: ...
    @property
    def reference(self) -> Any: ...
    def curve(self, scheme: str) -> Sequence[Any]: ...
    def pareto(self, work: str) -> Sequence[Any]: ...


def plot_work_precision(
    study: RunsByWork, title: str = "", work: str = "seconds", theme: Theme = LIGHT
) -> NotebookFigure:
    """Error of the positions against work, one curve per scheme; the Pareto front is underlaid.

    Args:
        study: e.g. of `vmri_jax.study.work_precision`, or the runs of a recommendation.
        title: over the figure.
        work: "seconds", "slow_evaluations", "fast_evaluations" or "solves".
        theme: colours.

    Raises:
        ValueError: another kind of work.
    """
    if work not in WORK:
        raise ValueError(f"plot_work_precision: work is {work!r}; it must be one of {', '.join(WORK)}.")
    front = [row for row in study.pareto(work) if getattr(row, work) > 0]
    with new_figure(7.2, 4.3, title, theme) as figure:
        axes = figure.subplots()
        best, errors = [getattr(row, work) for row in front], [row.error_q for row in front]
        under = {"color": theme.faint, "linewidth": 7, "solid_capstyle": "round", "zorder": 1}
        axes.loglog(best, errors, label="best of all", **under)
        for i, scheme in enumerate(study.schemes):
            curve = sorted(study.curve(scheme), key=lambda row: row.num_steps)
            x, y = [getattr(row, work) or np.nan for row in curve], [row.error_q for row in curve]
            look = _look(i, theme) | {"marker": MARKERS[i // len(theme.curves) % len(MARKERS)]}
            axes.loglog(x, y, label=scheme, markersize=4, linewidth=1.1, **look)
        axes.set(xlabel=WORK[work], ylabel=r"largest error $|q - q_{\mathrm{ref}}|$")
        axes.set_ylim(top=30 * max(errors, default=1.0))
        if study.reference.error_q > axes.get_ylim()[0]:
            axes.axhline(study.reference.error_q, color=theme.ink, linewidth=0.8, linestyle=":")
            above = {"ha": "right", "va": "bottom", "fontsize": 7.5, "transform": axes.get_yaxis_transform()}
            axes.text(0.995, study.reference.error_q, "error of the reference ", **above)
        log_ticks(axes.xaxis, [getattr(row, work) for scheme in study.schemes for row in study.curve(scheme)])
        if work == "seconds":
            axes.xaxis.set_major_formatter(EngFormatter("s"))
        _legend_beside(axes)
    return figure


def _look(i: int, theme: Theme) -> dict[str, Any]:
    """Colour and marker of curve i."""
    return {
        "color": theme.curves[i % len(theme.curves)],
        "marker": MARKERS[i % len(MARKERS)],
        "markerfacecolor": theme.paper,
    }


class CostCurves(Protocol):
    """By label and method: num_micro and microseconds per micro step."""

    @property
    def curves(self) -> Sequence[tuple[str, str]]: ...
    def curve(self, label: str, method: str) -> tuple[np.ndarray, np.ndarray]: ...


def plot_cost(
    studies: Mapping[str, CostCurves],
    paper_minima: Mapping[str, int] | None = None,
    title: str = "",
    theme: Theme = LIGHT,
) -> NotebookFigure:
    """Computing time per micro step against num_micro, one panel per study, the cheapest point of each curve circled.

    Args:
        studies: by the title of their panel, e.g. of `vmri_jax.study.cost_study`.
        paper_minima: num_micro to mark, by the title of the panel.
        title: over the figure.
        theme: colours.
    """
    columns = 2 if len(studies) == 4 else min(3, len(studies))
    height = 0.6 + 2.7 * math.ceil(len(studies) / columns)
    with new_figure(max(5.2, 0.6 + 3.0 * columns), height, title, theme) as figure:
        grid = panel_grid(figure, len(studies), columns)
        handles: dict = {}
        for axes, (name, study) in zip(grid, studies.items(), strict=True):
            _cost_panel(axes, study, (paper_minima or {}).get(name), theme)
            axes.set(title=name)
            shown = zip(*axes.get_legend_handles_labels(), strict=True)
            handles.update({label: handle for handle, label in shown})
        for axes in grid[-columns:]:
            axes.set(xlabel="micro steps per macro step")
        for axes in grid[::columns]:
            axes.set(ylabel="µs per micro step")
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=min(4, len(handles)))
    return figure


def _cost_panel(axes: Axes, study: CostCurves, paper_minimum: int | None, theme: Theme) -> None:
    one_label = len({label for label, _ in study.curves}) == 1
    curves = [study.curve(label, method) for label, method in study.curves]
    for i, ((label, method), (num_micro, cost)) in enumerate(zip(study.curves, curves, strict=True)):
        name = method if one_label else f"{label}, {method}"
        color = theme.curves[i % len(theme.curves)]
        axes.loglog(num_micro, cost, marker=MARKERS[i], markersize=4, color=color, label=name)
        if np.isfinite(cost).any():
            best = np.nanargmin(cost)
            axes.plot(num_micro[best], cost[best], "o", markersize=11, markerfacecolor="none", color=color)
    if paper_minimum is not None:
        axes.axvline(paper_minimum, color=theme.ink, linestyle=":", linewidth=1.1, label="minimum in the paper")
    ticks = np.unique(np.concatenate([num_micro for num_micro, _ in curves]))
    if len(ticks) > 7:
        ticks = np.array([1, 4, 12, 40, 100])
    axes.xaxis.set_major_locator(FixedLocator(ticks.tolist()))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter("{x:.0f}")
    log_ticks(axes.yaxis, np.concatenate([cost for _, cost in curves]))


def _coordinates(axes: Axes, t, values, names: Sequence[str], theme: Theme) -> None:
    """One line per coordinate with its name beside the panel; of very many every so manieth is named."""
    n = values.shape[1]
    colors: Any = theme.curves
    if n > len(theme.curves):
        low, high = (0.3, 1.0) if theme is DARK else (0.0, 0.88)
        colors = matplotlib.colormaps["viridis"](np.linspace(low, high, n))
    named = range(n) if n <= MOST_NAMED else np.linspace(0, n - 1, MOST_NAMED).round().astype(int)
    for i in range(n):
        label = names[i] if i in named else f"_{names[i]}"  # which legends leave out
        axes.plot(t, values[:, i], color=colors[i], linewidth=_thin(t), label=label)
    if n:
        _legend_beside(axes, f"{len(named)} of {n}" if n > MOST_NAMED else None, 9.0 if n <= len(theme.curves) else 6.5)


def _thin(t) -> float:
    """Line width for so many nodes: oscillations must not run into a solid band."""
    return 1.2 if len(t) <= 300 else 0.7


def _legend_beside(axes: Axes, title: str | None = None, size: float = 9.0) -> None:
    look = {"handlelength": 1.2, "fontsize": size, "title_fontsize": size, "labelspacing": 0.3}
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), title=title, **look)


def _energy_error(axes: Axes, trajectory: Run, theme: Theme) -> None:
    """Relative to the start, or absolute if the start is zero; a mere change if the system is not known."""
    t, energy = np.asarray(trajectory.t), np.asarray(trajectory.energy)
    what = "error" if trajectory.keeps_energy else "change"
    error, label = energy - energy[0], rf"energy {what} $\Delta E$"
    if abs(energy[0]) > 1e-12:
        error, label = error / abs(energy[0]), rf"{label[:-1]} / |E_0|$"
    axes.plot(t, error, color=theme.curves[0], linewidth=_thin(t))
    axes.set_ylabel(label)
    _not_below_roundoff(axes.yaxis, error)


def _energy_balance(above: Axes, below: Axes, trajectory: Run, theme: Theme) -> None:
    """Energy and work since the start, and under them what is left of the balance."""
    t, energy, work = np.asarray(trajectory.t), np.asarray(trajectory.energy), trajectory.work()
    curves = {"energy": energy - energy[0], "forces": work.forces, "moving constraints": work.constraints}
    for (name, values), color in zip(curves.items(), theme.curves, strict=False):
        if name == "energy" or np.any(values != 0):
            above.plot(
                t, values, color=color, linewidth=_thin(t), label=name if name == "energy" else f"work of {name}"
            )
    above.set_ylabel("energy and work")
    _legend_beside(above, size=7.5)
    below.plot(t, work.balance, color=theme.curves[0], linewidth=_thin(t), label=r"$\Delta E$ - work")
    below.axhspan(-work.uncertainty, work.uncertainty, color=theme.faint, label="not resolved\nby the nodes")
    below.set_ylabel("energy balance")
    _legend_beside(below, size=7.5)
    _not_below_roundoff(below.yaxis, energy)


def _not_below_roundoff(axis: Axis, values) -> None:
    """Limits that do not blow up round-off: they span `ROUNDOFF` of the values at least."""
    middle, size = np.nanmean(values), np.nanmax(np.abs(values), initial=0.0)
    low, high = axis.get_view_interval()
    half = ROUNDOFF * max(size, 1.0) / 2
    if high - low < 2 * half:
        axis.set_view_interval(middle - half, middle + half, ignore=True)


def log_ticks(axis: Axis, values: Sequence[float] | np.ndarray) -> None:
    """Labels at powers of ten, or at 1, 2, 5 if the values span little more than one of them.

    Args:
        axis: logarithmic.
        values: what is drawn along it.
    """
    finite = [value for value in values if np.isfinite(value)]
    axis.set_minor_formatter(NullFormatter())
    if finite and max(finite) < 30 * min(finite):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter("{x:g}")


def _guide_triangle(axes: Axes, study: ConvergenceErrors, quantity: str, order: int, theme: Theme) -> None:
    """Triangle of slope `order` right below the most accurate curve of about that order."""
    lowest = None
    for scheme in study.schemes:
        macro_dt, errors = study.usable(scheme, quantity)
        if len(errors) > 1 and abs(study.order(scheme, quantity) - order) < 0.5:
            middle = (len(errors) - 1) // 2
            value = errors[middle] / macro_dt[middle] ** order
            if lowest is None or value < lowest[0]:
                lowest = value, macro_dt[middle], errors[middle]
    if lowest is None:
        return
    _, right, top = lowest
    left, top = right / 2, top / 2.5
    bottom = top / 2**order
    axes.fill([left, right, right], [bottom, bottom, top], facecolor=theme.faint, edgecolor="none", zorder=1)
    axes.annotate(
        f"{order}", (right, (bottom * top) ** 0.5), (4, 0), textcoords="offset points", va="center", fontsize=8.5
    )

"""Figures of runs: positions, energies, constraints against time."""

from collections.abc import Sequence
from typing import Any, Protocol

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis

from vmri_jax.mechanics.invariants import oscillatory_energies
from vmri_jax.mechanics.names import Names
from vmri_jax.plots.theme import DARK, LIGHT, ROUNDOFF_FLOOR, NotebookFigure, Theme, legend_beside, new_figure

MOST_NAMED = 12
"""Most curves of a panel that the legend names; of more curves this number is named, evenly chosen."""
BAND = 0.25
"""Opacity of bands of errors; more opaque ones hide the curves of other coordinates."""
ROUNDOFF = 1e-13
"""Axes span this part of the values at least."""


class Run(Protocol):
    """Saved nodes of a run, (k,) and (k, n), and what is known of it, see `vmri_jax.Trajectory`."""

    @property
    def states(self) -> Any: ...
    @property
    def t(self) -> Any: ...
    @property
    def energy(self) -> Any: ...
    @property
    def constraint_residual(self) -> Any: ...
    @property
    def error(self) -> Any: ...
    @property
    def names(self) -> Names: ...
    @property
    def keeps_energy(self) -> bool | None: ...
    def work(self) -> Any: ...


def plot_trajectory(trajectory: Run, title: str = "", theme: Theme = LIGHT) -> NotebookFigure:
    """Slow and fast positions, energy and, where there are constraints, their residual, against time.

    Of rigid bodies it shows the centres of mass.

    A run with an estimated error has bands of it about its positions, and a panel of the largest error and its shares.

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
    t = np.asarray(trajectory.t)
    residual = np.asarray(trajectory.constraint_residual)
    constrained = bool(np.any(residual > 0))
    positions = position_panels(trajectory)
    driven = trajectory.keeps_energy is False
    has_error = getattr(trajectory, "error", None) is not None
    count = len(positions) + has_error + (2 if driven else 1) + constrained
    with new_figure(7.2, 0.4 + 1.85 * count, title, theme) as figure:
        axes = figure.subplots(count, sharex=True, squeeze=False)[:, 0]
        for panel, (values, labels, what, error) in zip(axes, positions, strict=False):
            coordinates(panel, t, values, labels, theme, error)
            panel.set_ylabel(what)
        below = axes[len(positions) :]
        if has_error:
            _position_error(below[0], t, trajectory.error, theme)
            below = below[1:]
        if driven:
            _energy_balance(below[0], below[1], trajectory, theme)
        else:
            _energy_error(below[0], trajectory, theme)
        if constrained:
            shown = np.maximum(residual, ROUNDOFF_FLOOR)  # NaN stays
            axes[-1].semilogy(t, shown[:, 0], "-", linewidth=_thin(t), label="position $|g|$")
            axes[-1].semilogy(t, shown[:, 1], "--", linewidth=_thin(t), label="velocity $|G v|$")
            axes[-1].set_ylabel("constraint residual")
            legend_beside(axes[-1])
        axes[-1].set(xlabel="time $t$")
        limit_times(axes[-1], t)
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
    energies = np.asarray(oscillatory_energies(omega, trajectory.states.q_f, trajectory.states.p_f))
    with new_figure(7.2, 3.4, title, theme) as figure:
        axes = figure.subplots()
        axes.plot(t, energies.sum(axis=1), color=theme.ink, linewidth=1.0, label=r"$I = \sum I_i$")
        coordinates(axes, t, energies, [f"$I_{{{i + 1}}}$" for i in range(energies.shape[1])], theme)
        axes.set(xlabel="time $t$", ylabel="oscillatory energy")
        limit_times(axes, t)
        axes.set_ylim(bottom=0)
    return figure


def position_panels(run: Run) -> list[tuple[np.ndarray, list[str], str, np.ndarray | None]]:
    """Slow and fast positions with their names, what they are called, and their errors; of rigid bodies the centres, without directors.

    Args:
        run: one run.
    """
    names, error = run.names, getattr(run, "error", None)
    slow, fast = (None, None) if error is None else (error.q_s, error.q_f)
    panels = (
        (run.states.q_s, names.positions("s"), names.slow_coordinates, r"slow positions $q_s$", slow),
        (run.states.q_f, names.positions("f"), names.fast_coordinates, r"fast positions $q_f$", fast),
    )
    return [
        (
            np.asarray(values)[:, shown],
            [labels[i] for i in shown],
            what,
            None if wrong is None else np.asarray(wrong)[:, shown],
        )
        for values, shown, labels, what, wrong in panels
        if shown
    ]


def limit_times(axes: Axes, t) -> None:
    """Limits of a time axis: the first and the last node that was reached; matplotlib's own where there is one node only."""
    reached = t[np.isfinite(t)]
    if reached.size and reached[0] < reached[-1]:
        axes.set_xlim(reached[0], reached[-1])


def coordinates(axes: Axes, t, values, names: Sequence[str], theme: Theme, error=None) -> None:
    """One line per coordinate with its name beside the panel; of very many every so manieth is named. About each a band of its error."""
    n = values.shape[1]
    colors: Any = theme.curves
    if n > len(theme.curves):
        low, high = (0.3, 1.0) if theme is DARK else (0.0, 0.88)
        colors = matplotlib.colormaps["viridis"](np.linspace(low, high, n))
    named = range(n) if n <= MOST_NAMED else np.linspace(0, n - 1, MOST_NAMED).round().astype(int)
    for i in range(n):
        label = names[i] if i in named else f"_{names[i]}"  # which legends leave out
        axes.plot(t, values[:, i], color=colors[i], linewidth=_thin(t), label=label)
        if error is not None:
            half = np.abs(error[:, i])
            axes.fill_between(t, values[:, i] - half, values[:, i] + half, color=colors[i], alpha=BAND, linewidth=0)
    if n:
        legend_beside(axes, f"{len(named)} of {n}" if n > MOST_NAMED else None, 9.0 if n <= len(theme.curves) else 6.5)


def _thin(t) -> float:
    """Line width for a number of nodes: oscillations must not run into a solid band."""
    return 1.2 if len(t) <= 300 else 0.7


def _position_error(axes: Axes, t, error: Any, theme: Theme) -> None:
    """Largest error of a position and its shares; where no error is certified, a shaded part."""
    curves = {"error": error.positions, "slow share": error.slow, "fast share": error.fast}
    for (name, values), look in zip(curves.items(), ("-", "--", ":"), strict=True):
        if np.isfinite(values).any():
            axes.semilogy(t, np.where(values > 0, values, np.nan), look, linewidth=_thin(t), label=name)
    if not np.isfinite(error.positions).all():
        axes.axvspan(float(error.certified_until), t[-1], color=theme.faint, label="not certified")
    axes.set_ylabel("error of positions")
    legend_beside(axes)


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
    legend_beside(above, size=7.5)
    below.plot(t, work.balance, color=theme.curves[0], linewidth=_thin(t), label=r"$\Delta E$ - work")
    below.axhspan(-work.uncertainty, work.uncertainty, color=theme.faint, label="not resolved\nby the nodes")
    below.set_ylabel("energy balance")
    legend_beside(below, size=7.5)
    _not_below_roundoff(below.yaxis, energy)


def _not_below_roundoff(axis: Axis, values) -> None:
    """Limits that do not blow up round-off: they span `ROUNDOFF` of the values at least."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return
    middle, size = finite.mean(), np.abs(finite).max()
    low, high = axis.get_view_interval()
    half = ROUNDOFF * max(size, 1.0) / 2
    if high - low < 2 * half:
        axis.set_view_interval(middle - half, middle + half, ignore=True)

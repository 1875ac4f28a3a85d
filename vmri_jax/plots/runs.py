"""Figures of runs: positions, energies, constraints against time."""

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis

from vmri_jax.plots.theme import DARK, LIGHT, ROUNDOFF_FLOOR, NotebookFigure, Theme, legend_beside, new_figure
from vmri_jax.refusals import Refused
from vmri_jax.running.origin import SavedRun

MOST_NAMED = 12
"""Most curves of a panel that the legend names; of more curves it names this number, evenly chosen. A larger number
makes the legend higher than the panel."""
BAND_OPACITY = 0.25
"""Opacity of the bands of errors; a larger value hides the curves of other coordinates."""
LEAST_SHOWN = 1e-9
"""Least reaction that is drawn, as a part of the largest one in its unit; a smaller value draws curves of round-off."""
LEAST_SPAN = 1e-13
"""Least span of an axis of energies, as a part of the largest value; a smaller one magnifies round-off."""


def plot_trajectory(trajectory: SavedRun, title: str = "", theme: Theme = LIGHT) -> NotebookFigure:
    """Slow and fast positions, energy and, where there are constraints, their residual, against time.

    Rigid bodies are drawn by their centres of mass. Angles of joints have a panel of their own.

    A run with an estimated error has bands of this error about its positions, and a panel of the largest error and its
    shares.

    If the system keeps its energy, the figure shows the error of the energy; if forces or moving constraints do work,
    it shows the change of the energy, the work, and their difference. Of a scheme with kicks, which act at the
    macro nodes, this balance has terms of H^2, a drift among them, unless the run saves its micro nodes.

    Args:
        trajectory: a run; nodes after a failure are NaN, which matplotlib leaves out.
        title: title above the panels.
        theme: colours.

    Raises:
        ValueError: a batch of runs.
    """
    if np.ndim(trajectory.t) != 1:
        raise Refused("plot: this is a batch of runs; take one of them, run.lane(i).")
    t = np.asarray(trajectory.t)
    residual = np.asarray(trajectory.constraint_residual)
    constrained = bool(np.any(residual > 0))
    positions = position_panels(trajectory)
    driven = trajectory.keeps_energy is False
    has_error = trajectory.error is not None
    count = len(positions) + has_error + (2 if driven else 1) + constrained
    with new_figure(7.2, 0.4 + 1.85 * count, title, theme) as figure:
        axes = figure.subplots(count, sharex=True, squeeze=False)[:, 0]
        for panel, (values, labels, quantity, error) in zip(axes, positions, strict=False):
            coordinates(panel, t, values, labels, quantity, theme, error)
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


def plot_forces(trajectory: SavedRun, title: str = "", theme: Theme = LIGHT) -> NotebookFigure:
    """Moduli of the reaction forces of all constraints against time, a curve for each constraint by name.

    There is a panel for each unit: forces on points and on centres of rigid bodies; torques about these centres,
    ``sum_i d_i x F_i`` of the forces on directors, and on angles of joints; forces on generalised coordinates. The axes
    have the units of a system in m, kg and s. Joints that carry bodies have no multiplier, and a line below the panels
    says so. The modulus is the largest over the bodies of the constraint; the two bodies of a link have the same.
    Forces themselves are those of ``run.reaction_forces()``.

    Args:
        trajectory: a run of a system with constraints; of a scene in joint coordinates ``scene.by_directors(run)``.
        title: title above the panels.
        theme: colours.

    Raises:
        ValueError: a batch of runs, a system without constraints, or a run that does not know its system.
    """
    if np.ndim(trajectory.t) != 1:
        raise Refused("plot_forces: this is a batch of runs; take one of them, run.lane(i).")
    t, panels = np.asarray(trajectory.t), _moduli(trajectory)
    with new_figure(7.2, 0.4 + 1.85 * len(panels), title, theme) as figure:
        axes = figure.subplots(len(panels), sharex=True, squeeze=False)[:, 0]
        for panel, (quantity, curves) in zip(axes, panels.items(), strict=True):
            coordinates(panel, t, np.stack(list(curves.values()), axis=1), list(curves), quantity, theme)
            panel.set_ylim(0.0, None)
        axes[-1].set(xlabel="time $t$")
        figure.align_ylabels()
        if trajectory.names.carried:
            figure.supxlabel(WITHOUT_CURVES, fontsize=7.5, x=0.01, ha="left")
    return figure


WITHOUT_CURVES = "Joints that carry bodies have no curves here: scene.by_directors(run).plot_forces() draws all joints."
"""Line below the forces of a scene in joint coordinates."""
UNITS = {
    "reaction force": "N",
    "torque about centres": "N m",
    "torque on angles": "N m",
    "generalised force": "N, or N m for an angle",
}
"""Units of reactions in a system in m, kg and s."""


def _moduli(run: SavedRun) -> dict[str, dict[str, np.ndarray]]:
    """For each unit, the largest modulus (k,) of the reaction on a body of each constraint, without round-off."""
    names, panels = run.names, {unit: {} for unit in UNITS}
    for constraint, by_body in run.reaction_forces().items():
        for body, force in by_body.items():
            kind = "generalised force" if body in names.numbered else "reaction force"
            kind = "torque on angles" if body in names.angles else kind
            reactions = {kind: force}
            if body in names.rigid:
                # (k, directors, 3): the first three entries are of the centre
                both = (np.asarray(a)[:, 3:].reshape(len(force), -1, 3) for a in (force, run.position(body)))
                pulls, directors = both
                reactions = {
                    "reaction force": force[:, :3],
                    "torque about centres": np.cross(directors, pulls).sum(axis=1),
                }
            for unit, reaction in reactions.items():
                curves, modulus = panels[unit], np.linalg.norm(reaction, axis=1)
                curves[constraint] = np.maximum(curves.get(constraint, 0.0), modulus)
    for curves in panels.values():
        largest = {name: np.nanmax(curve, initial=0.0) for name, curve in curves.items()}
        for name, size in largest.items():
            if not size > LEAST_SHOWN * max(largest.values()):
                del curves[name]
    return {f"{unit}\n{UNITS[unit]} in SI units": curves for unit, curves in panels.items() if curves}


def position_panels(run: SavedRun) -> list[tuple[np.ndarray, list[str], str, np.ndarray | None]]:
    """For slow and fast positions and angles of a run, without directors of rigid bodies: values (k, n), names, label
    of the axis, and errors (k, n) or None."""
    names, error, panels = run.names, run.error, []
    for part, pace, labels in (("s", "slow", names.slow_coordinates), ("f", "fast", names.fast_coordinates)):
        values = np.asarray(getattr(run.states, f"q_{part}"))
        turning = {place.start for name, place in names.bodies.items() if name in names.angles and place.part == part}
        kinds: dict[str, list[int]] = {}
        for i in names.positions(part):
            quantity = f"angles $q_{part}$, rad" if i in turning else f"positions $q_{part}$"
            kinds.setdefault(f"{pace} {quantity}", []).append(i)
        for quantity, shown in kinds.items():
            errors = None if error is None else np.asarray(getattr(error, f"q_{part}"))[:, shown]
            panels.append((values[:, shown], [labels[i] for i in shown], quantity, errors))
    return panels


def limit_times(axes: Axes, t) -> None:
    """Set the limits of a time axis to the first and the last node reached; leave the limits at a single node."""
    reached = t[np.isfinite(t)]
    if reached.size and reached[0] < reached[-1]:
        axes.set_xlim(reached[0], reached[-1])


def coordinates(axes: Axes, t, values, names: Sequence[str], quantity: str, theme: Theme, error=None) -> None:
    """One curve for each coordinate, with a band of its error; at most `MOST_NAMED` names stand beside the panel."""
    n = values.shape[1]
    axes.set_ylabel(quantity)
    limit_times(axes, t)
    colors: Any = theme.curves
    if n > len(theme.curves):
        low, high = (0.3, 1.0) if theme is DARK else (0.0, 0.88)
        colors = matplotlib.colormaps["viridis"](np.linspace(low, high, n))
    named = range(n) if n <= MOST_NAMED else np.linspace(0, n - 1, MOST_NAMED).round().astype(int)
    for i in range(n):
        label = names[i] if i in named else f"_{names[i]}"  # legends leave out labels with an underscore
        axes.plot(t, values[:, i], color=colors[i], linewidth=_thin(t), label=label)
        if error is not None:
            half, look = np.abs(error[:, i]), {"color": colors[i], "alpha": BAND_OPACITY, "linewidth": 0}
            axes.fill_between(t, values[:, i] - half, values[:, i] + half, **look)
    if n:
        legend_beside(axes, f"{len(named)} of {n}" if n > MOST_NAMED else None, 9.0 if n <= len(theme.curves) else 6.5)


def _thin(t) -> float:
    """Line width: thinner for many nodes, so that oscillations do not fill a solid band."""
    return 1.2 if len(t) <= 300 else 0.7


def _position_error(axes: Axes, t, error: Any, theme: Theme) -> None:
    """Largest error of a position and its shares; times without a certified error are shaded."""
    curves = {"error": error.positions, "slow share": error.slow, "fast share": error.fast}
    for (name, values), look in zip(curves.items(), ("-", "--", ":"), strict=True):
        if np.isfinite(values).any():
            axes.semilogy(t, np.where(values > 0, values, np.nan), look, linewidth=_thin(t), label=name)
    if not np.isfinite(error.positions).all():
        axes.axvspan(float(error.certified_until), t[-1], color=theme.faint, label="not certified")
    axes.set_ylabel("error of positions")
    legend_beside(axes)


def _energy_error(axes: Axes, trajectory: SavedRun, theme: Theme) -> None:
    """Energy minus the energy at the start, divided by the latter unless it is zero; a change without a system."""
    t, energy = np.asarray(trajectory.t), np.asarray(trajectory.energy)
    kind = "error" if trajectory.keeps_energy else "change"
    error, label = energy - energy[0], rf"energy {kind} $\Delta E$"
    if abs(energy[0]) > 1e-12:
        error, label = error / abs(energy[0]), rf"{label[:-1]} / |E_0|$"
    axes.plot(t, error, color=theme.curves[0], linewidth=_thin(t))
    axes.set_ylabel(label)
    _not_below_roundoff(axes.yaxis, error)


def _energy_balance(above: Axes, below: Axes, trajectory: SavedRun, theme: Theme) -> None:
    """Energy and work since the start, and in the panel below the change of the energy minus the work."""
    t, energy, work = np.asarray(trajectory.t), np.asarray(trajectory.energy), trajectory.work()
    curves = {"energy": energy - energy[0], "forces": work.forces, "moving constraints": work.constraints}
    for (name, values), color in zip(curves.items(), theme.curves, strict=False):
        if name == "energy" or np.any(values != 0):
            label = name if name == "energy" else f"work of {name}"
            above.plot(t, values, color=color, linewidth=_thin(t), label=label)
    above.set_ylabel("energy and work")
    legend_beside(above, size=7.5)
    below.plot(t, work.balance, color=theme.curves[0], linewidth=_thin(t), label=r"$\Delta E$ - work")
    below.axhspan(-work.uncertainty, work.uncertainty, color=theme.faint, label="not resolved\nby the nodes")
    below.set_ylabel("energy balance")
    if trajectory.micro is None:
        terms = "at macro nodes forces have terms of $H^2$, a drift among them; fewer with Save(micro=True)"
        below.set_title(terms, fontsize=7.5)
    legend_beside(below, size=7.5)
    _not_below_roundoff(below.yaxis, energy)


def _not_below_roundoff(axis: Axis, values) -> None:
    """Widen the limits of an axis to `LEAST_SPAN` of the largest value, so that round-off is not magnified."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return
    middle, size = finite.mean(), np.abs(finite).max()
    low, high = axis.get_view_interval()
    half = LEAST_SPAN * max(size, 1.0) / 2
    if high - low < 2 * half:
        axis.set_view_interval(middle - half, middle + half, ignore=True)

"""Positions of all bodies at any time of a trajectory: nodes, velocities at the nodes, and a cubic polynomial between
two nodes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from vmri_jax.animation.drawing import Drawing, bars, with_bars
from vmri_jax.mechanics.checks import check_type
from vmri_jax.mechanics.state import HasProblem, Problem, opened
from vmri_jax.mechanics.system import System
from vmri_jax.refusals import Refused
from vmri_jax.running.micro_nodes import Nodes, why_not, with_micro_nodes
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.steppers.results import Result


@dataclass(frozen=True)
class Motion:
    """Positions of the bodies of a drawing, a cubic Hermite polynomial between nodes.

    Attributes:
        drawing: with a body for each coordinate of its blocks, see `bars`.
        t: (k,) times of the nodes.
        points, velocities: (k, n_bodies, 3) in the coordinates of the picture, where z points upwards.
        energy: (k, c) change of the energy since the start. For a system that keeps its energy it is relative to the
            energy at the start, unless that is zero. For other systems there are further columns: the work of forces
            and of moving constraints since the start, and the balance: the change of the energy minus both works.
        energy_names: names of the c columns.
        relative: whether the change of the energy is relative.
        residual: (k, 2) largest value and largest rate of a constraint.
        ending: a sentence about the failure of the run; empty if the run did not fail.
    """

    drawing: Drawing
    t: np.ndarray
    points: np.ndarray
    velocities: np.ndarray
    energy: np.ndarray
    energy_names: tuple[str, ...]
    relative: bool
    residual: np.ndarray
    ending: str = ""

    def at(self, times: Sequence[float] | np.ndarray) -> np.ndarray:
        """(len(times), n_bodies, 3) positions; before the start the first, after the end the last positions.

        Args:
            times: in any order.
        """
        if len(self.t) == 1:
            return np.repeat(self.points, len(times), axis=0)
        return CubicHermiteSpline(self.t, self.points, self.velocities)(np.clip(times, self.t[0], self.t[-1]))

    def between(self, start: float | None = None, end: float | None = None) -> "Motion":
        """The part between the nodes around two times.

        Args:
            start, end: the times; None for the start or the end of the run.

        Raises:
            ValueError: times outside of the run, or no time between them.
        """
        first, last = float(self.t[0]), float(self.t[-1])
        start, end = (first if start is None else start), (last if end is None else end)
        if not first <= start < end <= last and (start, end) != (first, last):
            raise Refused(
                f"from {start:g} to {end:g} is no part of the run, which goes from t = {first:g} to {last:g}."
            )
        low = int(np.searchsorted(self.t, start, side="right")) - 1
        part = slice(low, int(np.searchsorted(self.t, end)) + 1)
        names = ("t", "points", "velocities", "energy", "residual")
        return replace(self, **{name: getattr(self, name)[part] for name in names})

    def thinned(self, most: int) -> "Motion":
        """The motion at every k-th node; energy and residual are the largest of the nodes that each node stands for.

        Args:
            most: about the largest number of nodes.
        """
        every = -(-len(self.t) // most)
        if every == 1:
            return self
        kept = np.append(np.arange(0, len(self.t) - 1, every), len(self.t) - 1)
        parts = np.split(self.energy, kept[1:])
        columns = np.arange(self.energy.shape[1])
        return replace(
            self,
            t=self.t[kept],
            points=self.points[kept],
            velocities=self.velocities[kept],
            energy=np.array([part[np.argmax(np.abs(part), axis=0), columns] for part in parts]),
            residual=np.maximum.reduceat(self.residual, kept),
        )


def motion(
    trajectory: Trajectory, drawing: Drawing | Problem | HasProblem | dict | str, system: System | None = None
) -> Motion:
    """The motion of a drawing along a run, up to a failure of the run: ``write_html(motion(run, scene), "run.html")``.

    Velocities at the nodes follow from the momenta if the system is known, else from central differences. If the run
    kept the micro nodes of all its macro steps, they are nodes as well; without the system, fast velocities are then
    the derivatives of a cubic spline through all nodes.

    Args:
        trajectory: one run, of at least one node.
        drawing: of the system that was simulated. A scene or a problem stands for its drawing, a problem without a
            drawing for a bar for each coordinate, a dictionary or its JSON text for `Drawing.from_dict` of it.
        system: the system that was simulated; None for the system that the run carries, if it does.

    Raises:
        ValueError: a batch of runs, no node that is finite, a drawing or system of other coordinates.
    """
    if np.ndim(trajectory.t) != 1:
        raise Refused(f"motion: the trajectory is a batch of shape {np.shape(trajectory.t)[:-1]}; give one run of it.")
    drawing = _drawing(trajectory, drawing)
    q_s, q_f, t = (np.asarray(a, dtype=float) for a in (trajectory.states.q_s, trajectory.states.q_f, trajectory.t))
    finite = np.isfinite(np.concatenate([q_s, q_f, t[:, None]], axis=1)).all(axis=1)
    count = len(t) if finite.all() else int(np.argmin(finite))
    if count == 0:
        raise Refused("motion: the trajectory has no node with finite positions; there is nothing to draw.")
    run = (trajectory if system is None else trajectory.of(system))[:count]
    t, q_s, q_f = t[:count], q_s[:count], q_f[:count]
    v_s, v_f = map(np.asarray, run.velocities) if run.origin.simulated is not None else _differences(t, q_s, q_f)
    all_nodes = Nodes(t, q_s, q_f, v_s, v_f)
    if run.micro is not None and not why_not(t, run.micro):
        all_nodes = with_micro_nodes(all_nodes, *run.micro)
        if run.origin.simulated is None:  # differences between macro nodes miss the fast motion
            all_nodes = all_nodes._replace(v_f=CubicSpline(all_nodes.t, all_nodes.q_f)(all_nodes.t, 1))
    times, *phase = all_nodes
    slow, fast, v_slow, v_fast = drawing.extended(*phase)
    drawing = with_bars(drawing, slow, fast)
    offset, matrix = drawing.maps(slow.shape[1], fast.shape[1])
    q, v = np.concatenate([slow, fast], axis=1), np.concatenate([v_slow, v_fast], axis=1)
    energies, relative = _energies(run)
    residual = np.asarray(run.constraint_residual, dtype=float).reshape(count, -1)
    return Motion(
        drawing,
        times,
        offset + np.einsum("iaq,kq->kia", matrix, q),
        np.einsum("iaq,kq->kia", matrix, v),
        np.stack([np.interp(times, t, column) for column in energies.values()], axis=1),
        tuple(energies),
        relative,
        np.stack([np.interp(times, t, column) for column in residual.T], axis=1),
        _ending(trajectory, count),
    )


def _drawing(trajectory: Trajectory, shown: Any) -> Drawing:
    """The drawing of a scene, a problem, or plain data; of a problem without a drawing, a bar for each coordinate."""
    shown = opened(shown)
    if isinstance(shown, Problem):
        shown = shown.drawing or bars(trajectory)
    if isinstance(shown, dict | str):
        shown = Drawing.from_dict(shown)
    check_type("motion: drawing", shown, Drawing, "the scene or the problem of the run, or a Drawing")
    return shown


def _energies(run: Trajectory) -> tuple[dict[str, np.ndarray], bool]:
    """Columns of `Motion.energy` by name, and `Motion.relative`."""
    energy = np.asarray(run.energy, dtype=float)
    change = energy - energy[0]
    if run.keeps_energy is False:
        work = run.work()
        parts = {"work of forces": work.forces, "work of moving constraints": work.constraints}
        works = {name: values for name, values in parts.items() if np.any(values != 0)}
        return {"energy": change, **works, "balance": work.balance}, False
    relative = bool(abs(energy[0]) > 1e-12)
    name = "energy error" if run.keeps_energy else "energy change"
    return {name: change / (abs(energy[0]) if relative else 1.0)}, relative


def _differences(t, *values) -> list[np.ndarray]:
    """Central differences, and one-sided differences of second order at the ends; zero for a single node."""
    if len(t) == 1:
        return [np.zeros_like(x) for x in values]
    return [np.gradient(x, t, axis=0, edge_order=2 if len(t) > 2 else 1) for x in values]


def _ending(trajectory: Trajectory, count: int) -> str:
    failed = int(trajectory.failed_at)
    if failed < 0 and count == len(trajectory.t):
        return ""
    result = Result(int(trajectory.result))
    where = f"in macro step {failed}, " if failed >= 0 else ""
    last = float(trajectory.t[count - 1])
    return f"The run failed {where}after t = {last:.6g} ({result.name}); it is drawn up to there."

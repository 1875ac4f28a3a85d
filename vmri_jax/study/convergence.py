"""Convergence studies: errors of schemes over macro steps against a fine reference solution.

The error of a run is the largest difference over all saved nodes and all coordinates, slow and fast,

    error_q = max |q - q_ref|        error_p = max |p - p_ref|.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import vmri_jax as vm
from vmri_jax.study.table import Progress, silent, write_csv

FLOOR_FACTOR = 100.0
"""Errors below this many times the error of the reference say nothing about the scheme and are not fitted."""


@dataclass(frozen=True)
class ReferenceSolution:
    """What runs are compared with: q and p, shape (num_saves + 1, n_s + n_f), slow coordinates first.

    error_q, error_p: how accurate they are; errors near them are not fitted.
    """

    q: np.ndarray
    p: np.ndarray
    error_q: float = 0.0
    error_p: float = 0.0


@dataclass(frozen=True)
class ConvergenceRow:
    """One run: errors of positions and momenta, largest energy error and constraint residual, Newton, status."""

    scheme: str
    num_micro: int
    macro_dt: float
    error_q: float
    error_p: float
    energy_error: float
    constraint_residual: float
    iterations: int
    result: str


@dataclass(frozen=True)
class ConvergenceStudy:
    """Rows of a convergence study, schemes one after the other and macro steps as given."""

    rows: tuple[ConvergenceRow, ...]
    reference: ReferenceSolution

    @property
    def schemes(self) -> list[str]:
        """Labels of the schemes."""
        return list(dict.fromkeys(row.scheme for row in self.rows))

    def errors(self, scheme: str, quantity: str = "q") -> tuple[np.ndarray, np.ndarray]:
        """Macro steps, largest first, and errors of one scheme in "q" or "p"; failed runs are NaN."""
        rows = sorted((row for row in self.rows if row.scheme == scheme), key=lambda row: -row.macro_dt)
        if not rows:
            raise ValueError(f"errors: no scheme {scheme!r} in this study; it has {', '.join(self.schemes)}.")
        return np.array([row.macro_dt for row in rows]), np.array([getattr(row, f"error_{quantity}") for row in rows])

    def usable(self, scheme: str, quantity: str = "q") -> tuple[np.ndarray, np.ndarray]:
        """`errors` of the runs that did not fail and lie well above the error of the reference."""
        macro_dt, errors = self.errors(scheme, quantity)
        floor = getattr(self.reference, f"error_{quantity}")
        usable = np.isfinite(errors) & (errors > FLOOR_FACTOR * floor)
        return macro_dt[usable], errors[usable]

    def order(self, scheme: str, quantity: str = "q", points: int = 4) -> float:
        """Observed order: slope of log error over log step through the last `points` usable errors.

        NaN where fewer than two runs can be used.
        """
        macro_dt, errors = self.usable(scheme, quantity)
        if len(errors) < 2:
            return float("nan")
        return vm.diagnostics.observed_order(macro_dt[-points:], errors[-points:])

    def to_csv(self, path: str | Path) -> None:
        """Write the rows to a CSV file."""
        write_csv(path, self.rows)


def convergence_study(
    problem: vm.Problem,
    schemes: Mapping[str, vm.Scheme],
    macro_dt: Sequence[float],
    t_end: float,
    *,
    num_saves: int = 10,
    reference: ReferenceSolution | None = None,
    newton: vm.Newton | None = None,
    progress: Progress = silent,
) -> ConvergenceStudy:
    """Run every scheme with every macro step to `t_end` and compare with a reference.

    Each scheme is compiled once for all its step sizes. A run that fails becomes a row of NaN with its status.

    Args:
        problem: system and start.
        schemes: schemes by label.
        macro_dt: macro steps H; each must divide `t_end` into a multiple of `num_saves` steps.
        t_end: time simulated.
        num_saves: nodes compared, equally spaced over `t_end`.
        reference: compare with this; by default `reference_solution`.
        newton: how implicit equations are solved.
        progress: told about every run before it starts.

    Raises:
        ValueError: no scheme, a step that does not divide `t_end` as above, a reference of another shape.
    """
    if not schemes:
        raise ValueError(
            "convergence_study: schemes is empty; give at least one, e.g. {'midpoint': fully_implicit(5)}."
        )
    steps = [_num_steps(t_end, dt, num_saves) for dt in macro_dt]
    if not steps:
        raise ValueError("convergence_study: macro_dt is empty; give the macro steps to run.")
    state = problem.state()
    total = len(schemes) * len(steps)
    if reference is None:
        progress("reference solution", 0, total)
        reference = reference_solution(problem, t_end, num_saves=num_saves)
    shape = (num_saves + 1, state.q_s.size + state.q_f.size)
    if reference.q.shape != shape or reference.p.shape != shape:
        raise ValueError(
            f"convergence_study: reference has q of shape {reference.q.shape} and p of shape {reference.p.shape}; both "
            f"must be {shape}: num_saves + 1 nodes from the start to t_end, slow coordinates first."
        )

    rows = []
    for label, scheme in schemes.items():
        for num_steps in steps:
            progress(f"{label}, H = {t_end / num_steps:g}", len(rows), total)
            trajectory = vm.simulate(
                problem.system,
                scheme,
                state,
                macro_dt=t_end / num_steps,
                num_steps=num_steps,
                save_every=num_steps // num_saves,
                newton=newton,
                throw=False,
            )
            rows.append(_row(label, scheme, t_end / num_steps, trajectory, reference))
    progress("done", total, total)
    return ConvergenceStudy(tuple(rows), reference)


def reference_solution(
    problem: vm.Problem, t_end: float, *, num_saves: int = 10, num_steps: int = 1000, degree: int = 4
) -> ReferenceSolution:
    """Fine single-rate solution of order ``2 degree``, checked against itself at half the step.

    Args:
        problem: system and start.
        t_end: time simulated.
        num_saves: saved nodes, equally spaced over `t_end`.
        num_steps: steps of the coarser of the two runs, a multiple of `num_saves`; the finer one is returned.
        degree: polynomial degree of the path, with Gauss quadrature on every term.

    Returns:
        The solution; its errors are the largest differences between the two runs.

    Raises:
        SimulationError: a run failed; take more steps.
    """
    scheme = vm.galerkin(1, degree, "gauss")
    solutions = []
    for n in (num_steps, 2 * num_steps):
        trajectory = vm.simulate(
            problem.system, scheme, problem.state(), macro_dt=t_end / n, num_steps=n, save_every=n // num_saves
        )
        solutions.append(_joined(trajectory))
    (q_coarse, p_coarse), (q, p) = solutions
    return ReferenceSolution(q, p, float(np.abs(q - q_coarse).max()), float(np.abs(p - p_coarse).max()))


def _num_steps(t_end: float, macro_dt: float, num_saves: int) -> int:
    num_steps = round(t_end / macro_dt) if macro_dt > 0 else 0
    if num_steps < 1 or abs(num_steps * macro_dt - t_end) > 1e-9 * t_end or num_steps % num_saves:
        raise ValueError(
            f"convergence_study: macro_dt = {macro_dt:g} makes {t_end / macro_dt if macro_dt else float('inf'):.6g} steps "
            f"up to t_end = {t_end:g}; it must make a multiple of num_saves = {num_saves} whole steps, so that every run "
            "saves the same times."
        )
    return num_steps


def _joined(trajectory: vm.Trajectory) -> tuple[np.ndarray, np.ndarray]:
    return (
        np.concatenate([trajectory.q_s, trajectory.q_f], axis=1),
        np.concatenate([trajectory.p_s, trajectory.p_f], axis=1),
    )


def _row(label, scheme, macro_dt, trajectory: vm.Trajectory, reference: ReferenceSolution) -> ConvergenceRow:
    q, p = _joined(trajectory)
    return ConvergenceRow(
        scheme=label,
        num_micro=scheme.num_micro,
        macro_dt=macro_dt,
        error_q=float(np.abs(q - reference.q).max()),
        error_p=float(np.abs(p - reference.p).max()),
        energy_error=float(np.abs(trajectory.energy - trajectory.energy[0]).max()),
        constraint_residual=float(np.max(trajectory.constraint_residual)),
        iterations=int(np.max(trajectory.info.iterations)),
        result=vm.Result(int(trajectory.result)).name,
    )

"""Reference solutions: fine solutions that the errors of runs are measured against, with their own errors."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from vmri_jax.accuracy.companions import fewest_steps
from vmri_jax.diagnostics.linear import phase_vector
from vmri_jax.mechanics.driving import events
from vmri_jax.mechanics.state import HasProblem, Problem, problem_of
from vmri_jax.running.failures import simulation_error
from vmri_jax.running.prepare import prepare
from vmri_jax.running.progress import shows_progress
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.schemes.scheme import galerkin

ROUNDOFF = 1e-13
"""Difference of two runs, relative to the largest coordinate, that counts as round-off; a larger value ends with coarser steps."""
MAX_STEPS = 2**17
"""Number of macro steps from which steps are not halved any more; a larger number lets failing systems take longer to fail."""


@dataclass(frozen=True)
class ReferenceSolution:
    """Positions and momenta at the saved nodes, which errors of runs are measured against.

    q, p: (num_saves + 1, n_s + n_f), slow coordinates first.
    error_q, error_p: largest errors of q and p, estimated; errors of runs near these are not fitted.
    """

    q: np.ndarray
    p: np.ndarray
    error_q: float = 0.0
    error_p: float = 0.0

    @property
    def num_saves(self) -> int:
        """Saved nodes, the start not counted."""
        return len(self.q) - 1

    def errors(self, trajectory: Trajectory) -> tuple[float, float]:
        """Largest error of q and of p over nodes and coordinates; NaN for a run that failed."""
        q, p = joined(trajectory)
        return float(np.abs(q - self.q).max()), float(np.abs(p - self.p).max())


def joined(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """q and p, each (num_saves + 1, n_s + n_f), at the saved nodes, slow coordinates first."""
    q, p = np.split(np.asarray(phase_vector(trajectory.states)), 2, axis=-1)
    return q, p


@shows_progress
def reference_solution(
    problem: Problem | HasProblem,
    t_end: float,
    *,
    num_saves: int = 10,
    num_steps: int | None = None,
    degree: int = 4,
    progress: Any = False,
) -> ReferenceSolution:
    """Fine single-rate solution of order ``2 degree``, checked against itself at half the step.

    Args:
        problem: system and start; a `Problem` or a scene.
        t_end: time simulated.
        num_saves: saved nodes, equally spaced over `t_end`.
        num_steps: steps of the coarser of two runs, a multiple of `num_saves`; by default the step is halved until
            the difference of two runs is round-off or no longer falls.
        degree: polynomial degree of the path, with Gauss quadrature on every term.
        progress: True for a bar, or a function (what, done, total) that is told about every run.

    Events of forces are seen by every run, see `vmri_jax.mechanics.driving`.

    Returns:
        The finer of the two successive runs with the least difference in q; error_q and error_p are the largest
        differences between these two.

    Raises:
        SimulationError: runs failed with every number of steps; carries the last run.
    """
    problem = problem_of("reference_solution", problem)
    run = prepare(problem, galerkin(1, degree, "gauss"), macro_dt=t_end / num_saves, num_steps=num_saves)
    fixed = num_steps is not None
    drives = events(problem.system, run.state, float(run.state.t) + t_end)
    fewest = max(32, fewest_steps(run.scheme, drives, t_end))  # steps that see the events of forces
    n = num_steps if fixed else num_saves * -(-fewest // num_saves)
    coarse, best, last_error = None, None, np.inf
    while True:
        progress(f"reference solution, {n} steps", 0, 1)
        trajectory = run(macro_dt=t_end / n, num_steps=n, throw=False)
        fine = joined(trajectory) if bool(trajectory.success) else None
        if coarse is not None and fine is not None:
            error_q, error_p = (float(np.abs(a - b).max()) for a, b in zip(coarse, fine, strict=True))
            if best is None or error_q < best.error_q:
                best = ReferenceSolution(*fine, error_q, error_p)
            # a difference that no longer falls has reached round-off or the floor of a chaotic motion; above 1e-6 of the positions the steps may still be too large
            settled = error_q > last_error / 2 and error_q < 1e-6 * np.abs(fine[0]).max()
            if fixed or settled or error_q <= ROUNDOFF * np.abs(fine[0]).max():
                return best
            last_error = error_q
        if (fixed and (fine is None or n > num_steps)) or n >= max(MAX_STEPS, 2 * fewest):
            break
        coarse, n = fine, 2 * n
    if best is not None:
        return best
    raise simulation_error(trajectory, t_end / n, n // num_saves, num_micro=1)

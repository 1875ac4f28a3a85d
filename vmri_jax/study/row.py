"""Runs of a study: a row with errors, invariants, evaluations and time, and their table; the reference solution that
errors of runs are measured against, with its own errors."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from operator import attrgetter
from typing import Any

import numpy as np
from matplotlib.ticker import EngFormatter

from vmri_jax import plots
from vmri_jax.accuracy.companions import fewest_steps
from vmri_jax.diagnostics.linear import phase_vector
from vmri_jax.mechanics.driving import events
from vmri_jax.mechanics.state import HasProblem, Problem, problem_of
from vmri_jax.mechanics.system import System
from vmri_jax.mechanics.terms import label
from vmri_jax.running.failures import simulation_error
from vmri_jax.running.origin import Settings
from vmri_jax.running.prepare import prepare
from vmri_jax.running.progress import progress_to
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.schemes.composition import SchemeLike, stage_scheme
from vmri_jax.schemes.scheme import galerkin
from vmri_jax.steppers.results import Method, Result
from vmri_jax.study.table import Column, ResultTable

ROUNDOFF = 1e-13
"""Difference of two runs, relative to the largest coordinate, that counts as round-off; a larger value ends with
coarser steps."""
MAX_STEPS = 2**17
"""Number of macro steps from which steps are not halved any more; a larger number lets failing systems take longer to
fail."""


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

    Events of forces are seen by every run without `num_steps`, see `vmri_jax.mechanics.driving`.

    Returns:
        The finer of the two successive runs with the least difference in q; error_q and error_p are the largest
        differences between these two.

    Raises:
        SimulationError: runs failed with every number of steps; carries the last run.
    """
    with progress_to("reference_solution", progress) as tell:
        problem = problem_of("reference_solution", problem)
        run = prepare(problem, galerkin(1, degree, "gauss"), macro_dt=t_end / num_saves, num_steps=num_saves)
        first, halvings = num_steps, 1
        if first is None:
            drives = events(problem.system, run.state, float(run.state.t) + t_end)
            fewest = max(32, fewest_steps(run.scheme, drives, t_end))  # steps that see the events of forces
            first = num_saves * -(-fewest // num_saves)
            halvings = max(0, math.ceil(math.log2(max(MAX_STEPS, 2 * fewest) / first)))
        coarse, best, last_error = None, None, np.inf
        for n in (first * 2**k for k in range(halvings + 1)):
            tell(f"reference solution, {n} steps", 0, 1)
            trajectory = run(macro_dt=t_end / n, num_steps=n, throw=False)
            fine = joined(trajectory) if bool(trajectory.success) else None
            if coarse is not None and fine is not None:
                error_q, error_p = (float(np.abs(a - b).max()) for a, b in zip(coarse, fine, strict=True))
                if best is None or error_q < best.error_q:
                    best = ReferenceSolution(*fine, error_q, error_p)
                # a difference that no longer falls has reached round-off or the floor of a chaotic motion; above 1e-6
                # of the positions the steps may still be too large
                size = np.abs(fine[0]).max()
                if error_q <= ROUNDOFF * size or last_error / 2 < error_q < 1e-6 * size:
                    break
                last_error = error_q
            coarse = fine
        if best is None:
            raise simulation_error(run.with_arguments(macro_dt=t_end / n, num_steps=n), trajectory)
        return best


@dataclass(frozen=True)
class Row:
    """One run of a study; NaN, or None, where a study does not measure.

    scheme: label.
    family: name of the family of schemes that a search took the scheme from.
    error_q, error_p: largest error over the compared nodes, see `ReferenceSolution`; in a search `error_q` is the
        estimated error of the run, see `vmri_jax.accuracy.companions`.
    case: label of the parameters, "" if there is one set only.
    energy_error: largest error of the energy: its change since the start where the system keeps its energy; its
        difference from the energy of the reference where forces or moving constraints do work.
    constraint_residual: largest constraint value, of positions or velocities.
    seconds: median of the time of the run, without compiling; in a search of the time of its steps.
    slow_evaluations, fast_evaluations: evaluations of the gradients of V and of W in the whole run, counted from the
        scheme and the Newton passes that the run reports, one evaluation per pass.
    evaluations: evaluations of the gradients of further potentials, by name.
    solves: systems of equations solved in the whole run.
    iterations: most Newton iterations of a step.
    method, result: names of the costliest `Method` and of the `Result`.
    stages, degree: stages of the composition, and degree of the path.
    settings: arguments of `vmri_jax.simulate` that repeat a run of a search.
    """

    scheme: str
    num_micro: int
    order: int
    num_steps: int
    macro_dt: float
    error_q: float
    error_p: float = np.nan
    case: str = ""
    family: str = ""
    energy_error: float = np.nan
    constraint_residual: float = np.nan
    seconds: float = np.nan
    slow_evaluations: int = 0
    fast_evaluations: int = 0
    evaluations: Mapping[str | int, int] = field(default_factory=dict)
    solves: int = 0
    iterations: int = 0
    method: str = ""
    result: str = ""
    stages: int = 1
    degree: int = 1
    settings: Settings = None  # pyright: ignore[reportAssignmentType] (as of `Trajectory.settings`)

    @property
    def failed(self) -> bool:
        """Whether a step failed, or the error is not known."""
        return not np.isfinite(self.error_q)


class RunTable(ResultTable):
    """A table of runs of several schemes."""

    rows: tuple[Row, ...]

    @property
    def schemes(self) -> list[str]:
        """Labels of the schemes."""
        return list(dict.fromkeys(row.scheme for row in self.rows))

    def records(self) -> list[dict[str, Any]]:
        """The rows as dictionaries, with an entry for the gradients of each further potential."""
        return list(map(record, self.rows))


def record(row: Row) -> dict[str, Any]:
    """A row as a dictionary of plain values."""
    plain = asdict(replace(row, settings=None))  # pyright: ignore[reportArgumentType]
    further = plain.pop("evaluations")
    del plain["settings"]
    return plain | {f"evaluations of {label(name)}": count for name, count in further.items()}


def row_of(
    name: str,
    system: System,
    scheme: SchemeLike,
    run: Trajectory,
    macro_dt: float,
    num_steps: int,
    energies: np.ndarray | None = None,
    **measured,
) -> Row:
    """The row of a run, with its invariants and evaluations, without a time; `energies` are right energies at the saved
    nodes, None for the energy at the start."""
    cost, passes = scheme.describe(), np.maximum(np.asarray(run.info.iterations), 1)
    method = Method(int(np.max(run.info.method)))
    solves = cost.constrained_solves if system.is_constrained else cost.solves
    evaluations = num_steps * float(passes.mean())
    stage, further = stage_scheme(scheme), system.potentials
    energy = np.asarray(run.energy)
    energy_error = energy - (energy[0] if energies is None else energies)
    return Row(
        scheme=name,
        num_micro=scheme.num_micro,
        order=scheme.order,
        num_steps=num_steps,
        macro_dt=macro_dt,
        energy_error=float(np.abs(energy_error).max()),
        constraint_residual=float(np.max(run.constraint_residual)),
        slow_evaluations=round(evaluations * cost.slow_evaluations),
        fast_evaluations=round(evaluations * cost.fast_evaluations),
        evaluations={name: round(evaluations * cost.stages * stage.evaluations_of(name)) for name in further},
        solves=num_steps * solves if method > Method.EXPLICIT else 0,
        iterations=int(np.max(run.info.iterations)),
        method=method.name,
        result=Result(int(run.result)).name,
        stages=cost.stages,
        degree=cost.degree,
        **measured,
    )


def duration(seconds: float) -> str:
    """A time with its unit: 12 µs, 3.4 ms, 1.2 s; empty for NaN."""
    return "" if np.isnan(seconds) else EngFormatter("s")(float(f"{seconds:.3g}"))


@dataclass(frozen=True, repr=False)
class WorkPrecision(RunTable):
    """Runs by their errors and their work; its table is the Pareto front.

    reference: the solution that errors are measured against; None for a search, whose errors are estimated by companion
        runs.
    """

    columns = (
        Column("scheme", lambda row: row.scheme),
        Column("H", lambda row: f"{row.macro_dt:.4g}", right=True),
        Column("steps", lambda row: f"{row.num_steps:,}", right=True),
        Column("error of q", lambda row: f"{row.error_q:.1e}", right=True),
        Column("time", lambda row: duration(row.seconds), right=True),
        Column("grad V", lambda row: f"{row.slow_evaluations:,}", right=True),
        Column("grad W", lambda row: f"{row.fast_evaluations:,}", right=True),
        Column("further gradients", lambda row: ", ".join(f"{label(k)} {n:,}" for k, n in row.evaluations.items())),
        Column("solves", lambda row: f"{row.solves:,}", right=True),
    )
    rows: tuple[Row, ...]
    reference: ReferenceSolution | None = None

    @property
    def known_to(self) -> float:
        """Error of the positions of the reference; 0 without one."""
        return 0.0 if self.reference is None else self.reference.error_q

    def curve(self, scheme: str) -> list[Row]:
        """The runs of a scheme that did not fail, the coarsest first."""
        return [row for row in self.rows if row.scheme == scheme and not row.failed]

    def pareto(self, work: str = "seconds") -> list[Row]:
        """The runs that no other one beats both in error and in work, the cheapest first.

        Args:
            work: "seconds", "slow_evaluations", "fast_evaluations" or "solves".
        """
        front, done = [], [row for row in self.rows if np.isfinite([row.error_q, getattr(row, work)]).all()]
        for row in sorted(done, key=attrgetter(work, "error_q")):
            if not front or row.error_q < front[-1].error_q:
                front.append(row)
        return front

    def keeping(self, error: float) -> list[Row]:
        """The runs that keep an error of the positions and whose time is known, the fastest first."""
        kept = [row for row in self.rows if row.error_q <= error and np.isfinite(row.seconds)]
        return sorted(kept, key=attrgetter("seconds"))

    def shown(self) -> list[Row]:
        """The Pareto front, by numbers of steps where no run has a time."""
        return self.pareto() or self.pareto("num_steps")

    def plot(self, title: str = "", work: str = "seconds"):
        """Error against work, see `vmri_jax.plots.plot_work_precision`."""
        return plots.plot_work_precision(self, title, work)

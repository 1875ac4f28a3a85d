"""Work and precision: errors of runs against their time and their evaluations, and the Pareto front of all runs."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from operator import attrgetter
from typing import Any

import numpy as np

from vmri_jax import plots
from vmri_jax.executors.executor import mapped
from vmri_jax.mechanics.linearisation import linearise
from vmri_jax.mechanics.state import HasProblem, Problem, problem_of
from vmri_jax.mechanics.system import System, label
from vmri_jax.running.interrupts import Interrupted
from vmri_jax.running.progress import shows_progress
from vmri_jax.running.settings import Settings
from vmri_jax.running.timing import interleaved
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.schemes.composition import Composition, stage_scheme
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.results import Method, Result
from vmri_jax.steppers.solver import Solver
from vmri_jax.study.machine import machine
from vmri_jax.study.program import Program
from vmri_jax.study.reference_solution import ReferenceSolution, reference_solution
from vmri_jax.study.table import Column, ResultTable

FINEST_ERROR = 1e-10
"""Error of positions, relative to the largest one, below which a ladder of steps ends; a smaller value adds finer runs, which round-off may spoil."""
SLOWEST = 2.0
"""Seconds of a run after which a ladder of steps ends; a larger value adds slower runs."""
RESOLVED_ERROR = 1e-6
"""Error of positions, relative to the largest one, below which a ladder ends when errors stop falling; a larger value may end it at steps that resolve nothing yet."""
LEAST_GAIN = 1.5
"""Ratio of the least error so far to the next error below which errors have stopped falling; a larger ratio ends ladders earlier."""


@dataclass(frozen=True)
class WorkRow:
    """One run: its errors, its time and its evaluations.

    scheme: label.
    error_q, error_p: largest error over the compared nodes, see `ReferenceSolution`; in a search `error_q` is the estimated error of the run,
        see `vmri_jax.accuracy.companions`, and `error_p` is NaN.
    seconds, low, high: median and quartiles of the wall time of the run, without compiling; in a search `seconds` are those of the steps.
    compile_seconds: time to compile the program that all runs of the scheme share; NaN in a search.
    slow_evaluations, fast_evaluations: evaluations of the gradients of V and of W in the whole run, counted from the scheme
        and the Newton passes that the run reports, one evaluation per pass.
    solves: systems of equations solved in the whole run.
    iterations: most Newton iterations of a step.
    method, result: names of the costliest `Method` and of the `Result`.
    stages, degree: stages of the composition, and degree of the path.
    evaluations: evaluations of the gradients of further potentials, by name.
    settings: arguments of `vmri_jax.simulate` that repeat a run of a search; None for other runs.
    """

    scheme: str
    num_micro: int
    order: int
    num_steps: int
    macro_dt: float
    error_q: float
    error_p: float = np.nan
    seconds: float = np.nan
    low: float = np.nan
    high: float = np.nan
    compile_seconds: float = np.nan
    slow_evaluations: int = 0
    fast_evaluations: int = 0
    solves: int = 0
    iterations: int = 0
    method: str = ""
    result: str = ""
    stages: int = 1
    degree: int = 1
    evaluations: Mapping[str | int, int] = field(default_factory=dict)
    settings: Settings = None  # pyright: ignore[reportAssignmentType] (as of `Trajectory.settings`)

    def timed(self, seconds: Sequence[float]) -> "WorkRow":
        """The row with the median and the quartiles of these samples."""
        low, middle, high = (float(x) for x in np.quantile(seconds, (0.25, 0.5, 0.75)))
        return replace(self, seconds=middle, low=low, high=high)


def duration(seconds: float) -> str:
    """A time with its unit: 12 µs, 3.4 ms, 1.2 s."""
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 1e-6:.2g} µs"


@dataclass(frozen=True)
class WorkPrecision(ResultTable):
    """Rows of one comparison; its table is the Pareto front.

    reference: the solution that errors are measured against; None for a search, whose errors are estimated by companion runs.
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
    rows: tuple[WorkRow, ...]
    t_end: float
    reference: ReferenceSolution | None = None

    @property
    def known_to(self) -> float:
        """Error of the positions of the reference; 0 without one."""
        return 0.0 if self.reference is None else self.reference.error_q

    @property
    def schemes(self) -> list[str]:
        """Labels of the schemes."""
        return list(dict.fromkeys(row.scheme for row in self.rows))

    def curve(self, scheme: str) -> list[WorkRow]:
        """The runs of a scheme that did not fail, the coarsest first."""
        return [row for row in self.rows if row.scheme == scheme and np.isfinite(row.error_q)]

    def pareto(self, work: str = "seconds") -> list[WorkRow]:
        """The runs that no other one beats both in error and in work, the cheapest first.

        Args:
            work: "seconds", "slow_evaluations", "fast_evaluations" or "solves".
        """
        return pareto_front(self.rows, work, "error_q")

    def shown(self) -> list[WorkRow]:
        """The Pareto front."""
        return self.pareto()

    def records(self) -> list[dict[str, Any]]:
        """The rows as dictionaries, with an entry for the gradients of each further potential."""
        records = []
        for row in self.rows:
            record = asdict(replace(row, settings=None))  # pyright: ignore[reportArgumentType]
            further = record.pop("evaluations")
            del record["settings"]
            records.append(record | {f"evaluations of {label(name)}": count for name, count in further.items()})
        return records

    def content(self) -> dict[str, Any]:
        """Rows, error of the reference, machine and versions."""
        known = {} if self.reference is None else {"reference": self.reference.errors_known()}
        return {"t_end": self.t_end, **known, "machine": machine(), **super().content()}

    def plot(self, title: str = "", work: str = "seconds"):
        """Error against work, see `vmri_jax.plots.plot_work_precision`."""
        return plots.plot_work_precision(self, title, work)


def pareto_front(items: Sequence[Any], work: str, error: str) -> list[Any]:
    """The items that no other item beats both in the attribute `work` and in the attribute `error`, the cheapest first."""
    front, finite = [], [item for item in items if np.isfinite(getattr(item, error))]
    for item in sorted(finite, key=attrgetter(work, error)):
        if not front or getattr(item, error) < getattr(front[-1], error):
            front.append(item)
    return front


def work_row(
    name: str,
    system: System,
    scheme: Scheme | Composition,
    trajectory: Trajectory,
    macro_dt: float,
    num_steps: int,
    **measured,
) -> WorkRow:
    """The row of a run, with its evaluations and without a time; `measured` are its errors, and what else is known."""
    cost, passes = scheme.describe(), np.maximum(np.asarray(trajectory.info.iterations), 1)
    method = Method(int(np.max(trajectory.info.method)))
    solves = cost.constrained_solves if system.is_constrained else cost.solves
    evaluations = num_steps * float(passes.mean())
    stage, further = stage_scheme(scheme), dict(system.potentials)
    return WorkRow(
        scheme=name,
        num_micro=scheme.num_micro,
        order=scheme.order,
        num_steps=num_steps,
        macro_dt=macro_dt,
        slow_evaluations=round(evaluations * cost.slow_evaluations),
        fast_evaluations=round(evaluations * cost.fast_evaluations),
        solves=num_steps * solves if method > Method.EXPLICIT else 0,
        iterations=int(np.max(trajectory.info.iterations)),
        method=method.name,
        result=Result(int(trajectory.result)).name,
        stages=cost.stages,
        degree=cost.degree,
        evaluations={name: round(evaluations * cost.stages * stage.evaluations_of(name)) for name in further},
        **measured,
    )


def _row(name: str, program: Program, num_steps: int, reference: ReferenceSolution) -> WorkRow:
    """Run the program; the row has its errors and evaluations, and NaN for its time."""
    trajectory = program(num_steps)
    error_q, error_p = reference.errors(trajectory)
    measured = {"error_q": error_q, "error_p": error_p, "compile_seconds": program.compile_seconds}
    return work_row(
        name, program.problem.system, program.scheme, trajectory, program.t_end / num_steps, num_steps, **measured
    )


@shows_progress
def work_precision(
    problem: Problem | HasProblem,
    schemes: Mapping[str, Scheme | Composition],
    t_end: float,
    *,
    num_steps: Sequence[int] | None = None,
    num_saves: int = 1,
    reference: ReferenceSolution | None = None,
    solver: Solver | None = None,
    repeats: int = 5,
    executor: Any = None,
    progress: Any = False,
) -> WorkPrecision:
    """Error against wall time and evaluations for every scheme over a ladder of macro steps.

    Every scheme is compiled once. All runs are made once for their errors; then they take turns on the clock, so that a
    slow moment of the machine hits all of them; a row has the median. A run that fails is a row of NaN.

    Args:
        problem: system and start; a `Problem` or a scene.
        schemes: schemes by label.
        t_end: simulated time.
        num_steps: numbers of macro steps, multiples of `num_saves`; by default the first has micro steps of
            ``degree / omega`` with the fastest angular frequency omega, and the number doubles until the error no longer falls
            or is below 1e-10, or a run takes two seconds.
        num_saves: nodes compared, equally spaced.
        reference: the solution that errors are measured against; by default `reference_solution`.
        solver: how implicit equations are solved.
        repeats: timed samples of every run.
        executor: where runs are computed and timed, a task for each scheme, as of `vmri_jax.ensemble`; None for this
            process. Workers measure the times on their machines, and only runs of one scheme take turns: each worker
            needs a core of its own for its times to count.
        progress: True for a bar, or a function (what, done, total) that is told about every run.

    Raises:
        ValueError: no scheme, or numbers of steps that are no multiples of num_saves.
        Interrupted: Ctrl-C; carries the runs that were done; a run whose turn had not come has the time of one call.
    """
    problem = problem_of("work_precision", problem)
    if not schemes:
        raise ValueError("work_precision: schemes is empty; give at least one, e.g. {'impulse': fully_explicit(10)}.")
    if num_steps is not None and (not len(num_steps) or any(n < 1 or n % num_saves for n in num_steps)):
        raise ValueError(f"work_precision: num_steps is {list(num_steps)}; give multiples of num_saves = {num_saves}.")
    if reference is None:
        reference = reference_solution(problem, t_end, num_saves=num_saves, progress=progress)
    frequency = float(linearise(problem).frequencies.max(initial=0.0))
    climbed = partial(_climbed, problem, t_end, num_saves, solver, num_steps, reference, frequency)
    total, runs = len(schemes) + 1, list[tuple[Program, WorkRow]]()
    try:
        if executor is None:
            for i, (label, scheme) in enumerate(schemes.items()):
                for run in climbed(
                    label, scheme, lambda n, i=i, label=label: progress(f"{label}, {n} steps", i, total)
                ):
                    runs.append(run)  # one by one, so that Ctrl-C keeps the runs of an unfinished ladder
            progress("measuring times", len(schemes), total)
            rows = timed_in_turn(runs, repeats)
        else:
            tasks = [(climbed, label, scheme, repeats) for label, scheme in schemes.items()]
            report = lambda done, i: progress(tasks[i][1], done, total)  # noqa: E731
            rows = [row for part in mapped("work_precision", _timed, tasks, executor, report) for row in part]
    except KeyboardInterrupt as stopped:
        parts = stopped.done if isinstance(stopped, Interrupted) else [[row for _, row in runs]]
        rows = [row for part in parts if part is not None for row in part]
        raise Interrupted(WorkPrecision(tuple(rows), t_end, reference), len(rows), None, "runs") from None
    progress("done", 1, 1)
    return WorkPrecision(tuple(rows), t_end, reference)


def _climbed(
    problem: Problem,
    t_end: float,
    num_saves: int,
    solver: Solver | None,
    num_steps: Sequence[int] | None,
    reference: ReferenceSolution,
    frequency: float,
    name: str,
    scheme: Scheme | Composition,
    report: Callable[[int], None] = lambda _: None,
) -> Iterator[tuple[Program, WorkRow]]:
    """All runs of a scheme over a ladder of macro steps, each with the time of one call; `report` gets their numbers of steps.

    With `num_steps` None they double until `_goes_on` ends the ladder.
    """
    program = Program(problem, scheme, t_end, num_saves, solver)
    per_save = frequency * t_end / scheme.num_micro / scheme.degree / num_saves
    queue, rows = list(num_steps or [num_saves * max(1, int(per_save))]), []
    while queue:
        n = queue.pop(0)
        report(n)
        seconds = interleaved({"": program.timed(n)}, 1, 0.0)[""]
        rows.append(_row(name, program, n, reference).timed(seconds))
        yield program, rows[-1]
        if num_steps is None and _goes_on(rows, reference):
            queue = [2 * n]


def _timed(climbed: Callable, name: str, scheme: Scheme | Composition, repeats: int) -> list[WorkRow]:
    """The rows of a ladder, timed in turn."""
    return timed_in_turn(list(climbed(name, scheme)), repeats)


def timed_in_turn(runs: Sequence[tuple[Program, WorkRow]], repeats: int) -> list[WorkRow]:
    """The rows with the medians of `repeats` runs that took turns; a row of a failed run stays as it is."""
    calls = {str(i): program.timed(row.num_steps) for i, (program, row) in enumerate(runs) if np.isfinite(row.error_q)}
    samples = interleaved(calls, repeats)
    return [row.timed(samples[str(i)]) if str(i) in samples else row for i, (_, row) in enumerate(runs)]


def _goes_on(rows: Sequence[WorkRow], reference: ReferenceSolution) -> bool:
    """Whether twice the steps of the last run may give a smaller error in acceptable time."""
    last, errors = rows[-1], [row.error_q for row in rows[:-1] if np.isfinite(row.error_q)]
    least = min(errors, default=np.inf)
    size = np.abs(reference.q).max()
    stopped_falling = least < RESOLVED_ERROR * size and not last.error_q < least / LEAST_GAIN  # true for NaN, too
    reached = last.error_q < max(FINEST_ERROR * size, reference.error_q)
    return not (reached or last.seconds > SLOWEST or stopped_falling)

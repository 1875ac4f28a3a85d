"""Cost studies: computing time of a fixed simulated time against num_micro, at a constant micro step."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import jax
import numpy as np

from vmri_jax.mechanics.state import Problem
from vmri_jax.running.simulate import simulate
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.newton import Newton
from vmri_jax.steppers.results import Result
from vmri_jax.study.table import Progress, silent, write_csv


@dataclass(frozen=True)
class CostRow:
    """One program: its size and its times.

    num_unknowns: unknowns of one macro step, ``r n_s + r n_gs + num_micro r (n_f + n_g)``.
    seconds_per_unit: computing time per unit of simulated time; the figures of the reference paper up to a constant.
    us_per_micro_step: the same per micro step, in microseconds.
    first_call_seconds: the first call: tracing, compiling and one run; in no other column.
    """

    label: str
    method: str
    num_micro: int
    num_unknowns: int
    num_steps: int
    seconds_per_unit: float
    us_per_micro_step: float
    first_call_seconds: float
    iterations: int
    result: str


@dataclass(frozen=True)
class CostStudy:
    """Rows of one or several cost studies."""

    rows: tuple[CostRow, ...]

    @property
    def curves(self) -> list[tuple[str, str]]:
        """The ``(label, method)`` pairs."""
        return list(dict.fromkeys((row.label, row.method) for row in self.rows))

    def curve(self, label: str, method: str) -> tuple[np.ndarray, np.ndarray]:
        """``num_micro`` and microseconds per micro step of one curve; failed runs are NaN."""
        rows = [row for row in self.rows if (row.label, row.method) == (label, method)]
        if not rows:
            raise ValueError(f"curve: no {(label, method)} in this study; it has {self.curves}.")
        return np.array([row.num_micro for row in rows]), np.array([row.us_per_micro_step for row in rows])

    def __add__(self, other: "CostStudy") -> "CostStudy":
        return CostStudy(self.rows + other.rows)

    def to_csv(self, path: str | Path) -> None:
        """Write the rows to a CSV file."""
        write_csv(path, self.rows)


def cost_study(
    problem: Problem,
    scheme: Callable[[int], Scheme],
    num_micro: Sequence[int],
    *,
    micro_dt: float,
    t_end: float,
    methods: Sequence[str] = ("dense", "arrowhead"),
    repeats: int = 5,
    min_seconds: float = 0.1,
    label: str = "",
    progress: Progress = silent,
) -> CostStudy:
    """Time ``scheme(n)`` for every n in `num_micro` with every linear solver, over the same simulated time.

    Where `t_end` is not a whole number of macro steps their number is rounded, and times are given per simulated unit
    and per micro step. A timed call is one compiled program, started once; take `t_end` long enough (thousands of micro
    steps for small systems) for the 0.1 ms of its start not to count.

    With several threads in the linear algebra times scatter; set OPENBLAS_NUM_THREADS=1 before the first simulation, as
    ``vmri reproduce`` does. Programs take turns in every repeat, so that a slow moment of the machine hits all of them; the median is kept.

    Args:
        problem: system and start.
        scheme: the scheme for a num_micro, e.g. `vmri_jax.fully_implicit`.
        num_micro: numbers of micro steps per macro step.
        micro_dt: the constant micro step h.
        t_end: simulated time of every timed run.
        methods: see `vmri_jax.Newton`.
        repeats: timed runs of each program.
        min_seconds: runs shorter than this are called several times, at most 20, and averaged.
        label: name of this scheme or system in the rows.
        progress: told about every program before it is compiled and every repeat.

    Raises:
        ValueError: an empty or bad argument.
    """
    if not num_micro or not methods or repeats < 1 or not (micro_dt > 0 and t_end > 0):
        raise ValueError(
            f"cost_study: num_micro = {list(num_micro)}, methods = {list(methods)}, repeats = {repeats}, "
            f"micro_dt = {micro_dt}, t_end = {t_end}; give at least one of each, and positive times."
        )
    state = problem.state()
    n_g, n_gs = problem.system.num_constraints(state.q_s, state.q_f)
    total = len(num_micro) * len(methods) + repeats
    programs, rows = [], []
    for method in methods:
        newton = Newton(method=method)  # pyright: ignore[reportArgumentType]
        for n in num_micro:
            progress(f"{label} {method}, {n} micro steps: compiling".strip(), len(programs), total)
            scheme_n = scheme(n)
            num_steps = max(1, round(t_end / (n * micro_dt)))
            run = _program(problem.system, scheme_n, state, n * micro_dt, num_steps, newton)
            first_call, trajectory = _seconds(run)
            calls = _calls_needed(run, min_seconds)
            programs.append((run, num_steps, calls))
            rows.append(
                CostRow(
                    label=label,
                    method=method,
                    num_micro=n,
                    num_unknowns=scheme_n.degree * (state.q_s.size + n_gs + n * (state.q_f.size + n_g)),
                    num_steps=num_steps,
                    seconds_per_unit=float("nan"),
                    us_per_micro_step=float("nan"),
                    first_call_seconds=first_call,
                    iterations=int(np.max(trajectory.info.iterations)),
                    result=Result(int(trajectory.result)).name,
                )
            )
    times = np.full((repeats, len(programs)), np.nan)
    for i in range(repeats):
        progress(f"{label} timing, repeat {i + 1} of {repeats}".strip(), len(programs) + i, total)
        for j, (run, num_steps, calls) in enumerate(programs):
            if rows[j].result in ("CONVERGED", "CONVERGED_AT_ROUNDOFF"):
                times[i, j] = _seconds(run, calls)[0] / num_steps
    progress("done", total, total)
    return CostStudy(tuple(_timed(row, np.median(times[:, j]), micro_dt) for j, row in enumerate(rows)))


def _program(system, scheme, state, macro_dt, num_steps: int, newton) -> Callable[[], Trajectory]:
    """One compiled run that saves its last node only; the checks of `simulate` happen once, while it is traced."""

    @jax.jit
    def run(system, scheme, state, macro_dt, newton):
        return simulate(
            system,
            scheme,
            state,
            macro_dt=macro_dt,
            num_steps=num_steps,
            save_every=num_steps,
            newton=newton,
            throw=False,
        )

    return partial(run, system, scheme, state, macro_dt, newton)


def _calls_needed(run, min_seconds: float) -> int:
    """How many calls last about `min_seconds` together."""
    seconds, _ = _seconds(run)
    return min(20, math.ceil(min_seconds / seconds))


def _seconds(run, calls: int = 1) -> tuple[float, Trajectory]:
    """Mean time of so many calls, at least one, and the trajectory."""
    start = time.perf_counter()
    trajectory = jax.block_until_ready(run())
    for _ in range(calls - 1):
        jax.block_until_ready(run())
    return (time.perf_counter() - start) / calls, trajectory


def _timed(row: CostRow, seconds_per_step: float, micro_dt: float) -> CostRow:
    per_micro_step = float(seconds_per_step) / row.num_micro
    return replace(row, seconds_per_unit=per_micro_step / micro_dt, us_per_micro_step=1e6 * per_micro_step)

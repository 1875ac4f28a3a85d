"""Programs, which studies run and time: one problem under one scheme, compiled once for all numbers of steps."""

import time
from dataclasses import replace

import numpy as np

from vmri_jax.diagnostics.linear import phase_vector
from vmri_jax.mechanics.state import Problem
from vmri_jax.running.prepare import prepare
from vmri_jax.running.timing import MIN_SECONDS, interleaved
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.solver import Solver


class Program:
    """``program(num_steps)`` simulates `problem` over `t_end` in num_steps macro steps.

    A program is a run of `vmri_jax.prepare` whose step size follows from the number of steps; it is compiled once for all problems of
    the same structure. A run that fails raises nothing: its trajectory has the result.

    Args:
        problem: system and start.
        scheme: a scheme or a composition.
        t_end: simulated time.
        num_saves: saved nodes, equally spaced; numbers of steps must be multiples of it.
        solver: how implicit equations are solved.
        fallback: whether "auto" may take its second method, which takes long to compile, where the first one fails.

    Attributes:
        compile_seconds: time of compiling.
    """

    def __init__(
        self,
        problem: Problem,
        scheme: Scheme | Composition,
        t_end: float,
        num_saves: int = 1,
        solver: Solver | None = None,
        fallback: bool = True,
    ):
        self.problem, self.scheme, self.t_end, self.num_saves = problem, scheme, float(t_end), num_saves
        self.state = problem.state()
        start = time.perf_counter()
        steps = {"macro_dt": self.t_end / num_saves, "num_steps": num_saves}
        run = prepare(problem.system, scheme, self.state, **steps, solver=solver)
        self.compile_seconds = time.perf_counter() - start
        self._run = replace(run, may_fall_back=fallback)

    def _steps(self, num_steps: int) -> dict:
        """The arguments of a run with this number of steps."""
        if num_steps < 1 or num_steps % self.num_saves:
            raise ValueError(f"Program: num_steps is {num_steps}; it must be a positive multiple of {self.num_saves}.")
        return {"macro_dt": self.t_end / num_steps, "num_steps": num_steps}

    def __call__(self, num_steps: int) -> Trajectory:
        """The trajectory with `num_saves` + 1 nodes, NaN from a failing step on.

        Raises:
            ValueError: num_steps is not a positive multiple of num_saves.
        """
        return self._run(**self._steps(num_steps), throw=False)

    def timed(self, num_steps: int):
        """A function without arguments for a clock: it makes a run and waits for its end, with the fallback if the run needs it."""
        return self._run.timed(**self._steps(num_steps))

    def seconds(self, num_steps: int, repeats: int, min_seconds: float = MIN_SECONDS) -> list[float]:
        """`repeats` samples of the time of a run, in seconds; runs shorter than `min_seconds` are averaged, see `interleaved`."""
        return interleaved({"": self.timed(num_steps)}, repeats, min_seconds)[""]


def joined(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """q and p, each (num_saves + 1, n_s + n_f), at the saved nodes, slow coordinates first."""
    q, p = np.split(np.asarray(phase_vector(trajectory.states)), 2, axis=-1)
    return q, p

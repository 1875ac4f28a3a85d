"""One problem under one scheme for every number of steps: what studies run and time."""

import time

import numpy as np

from vmri_jax.mechanics.state import Problem
from vmri_jax.running.simulate import simulation
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.newton import Newton


class Program:
    """``program(num_steps)`` simulates `problem` over `t_end` in so many macro steps.

    Compiled when first called, once for all problems of the same structure.

    A call costs some ten microseconds besides its steps. As in `vmri_jax.running.simulate`, "auto" takes the nested march and
    compiles its fallback only when a step needs it. A run that fails is seen in the trajectory; nothing is raised.

    Args:
        problem: system and start.
        scheme: a scheme or a composition.
        t_end: simulated time.
        num_saves: saved nodes, equally spaced; numbers of steps must be multiples of it.
        newton: how implicit equations are solved.
    """

    def __init__(
        self,
        problem: Problem,
        scheme: Scheme | Composition,
        t_end: float,
        num_saves: int = 1,
        newton: Newton | None = None,
    ):
        self.problem, self.scheme, self.t_end, self.num_saves = problem, scheme, float(t_end), num_saves
        macro_dt = self.t_end / num_saves
        state = problem.state()
        self.run = simulation(problem.system, scheme, state, newton, macro_dt, None, num_saves, 1, False)
        self.newton, self.state = self.run.newton, state
        self.compile_seconds = float("nan")

    def __call__(self, num_steps: int) -> Trajectory:
        """The trajectory with `num_saves` + 1 nodes.

        Raises:
            ValueError: num_steps is not a positive multiple of num_saves.
        """
        if np.isnan(self.compile_seconds):
            start = time.perf_counter()
            self.run()
            self.compile_seconds = time.perf_counter() - start  # and a run of the fewest steps
        return self.run(macro_dt=self.t_end / num_steps, num_steps=num_steps)

    def timed(self, num_steps: int):
        """A function without arguments that runs and waits, for a clock; takes the fallback if the run needs it."""
        return self.run.timed(macro_dt=self.t_end / num_steps, num_steps=num_steps)


def joined(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """q and p of the saved nodes, slow coordinates first."""
    return (
        np.concatenate([trajectory.q_s, trajectory.q_f], axis=-1),
        np.concatenate([trajectory.p_s, trajectory.p_f], axis=-1),
    )

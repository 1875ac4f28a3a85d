"""One problem under one scheme, compiled once for every number of steps: what studies run and time."""

import time
from dataclasses import replace
from functools import cached_property, partial

import jax
import numpy as np

import vmri_jax as vm
from vmri_jax.composition import Composition, stage_scheme
from vmri_jax.simulate import check_run, run
from vmri_jax.step import start_memory


@partial(jax.jit, static_argnames=("num_saves",))
def _from_the_start(system, scheme, newton, state, t_end, num_steps, save_every, num_saves) -> vm.Trajectory:
    macro_dt = t_end / num_steps
    memory = start_memory(system, scheme, state, macro_dt, newton)
    return run(system, scheme, newton, macro_dt, state.t, state, memory, 0, num_saves, save_every, False)[0]


class Program:
    """``program(num_steps)`` simulates `problem` over `t_end` in so many macro steps; compiled when first called.

    A call costs a tenth of a millisecond besides its steps. As in `vmri_jax.simulate`, "auto" takes the nested march and
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
        problem: vm.Problem,
        scheme: vm.Scheme | Composition,
        t_end: float,
        num_saves: int = 1,
        newton: vm.Newton | None = None,
    ):
        self.problem, self.scheme, self.t_end, self.num_saves = problem, scheme, float(t_end), num_saves
        self.newton, self.state = newton or vm.Newton(), problem.state()
        check_run(problem.system, scheme, self.state, self.newton, self.t_end / num_saves, None, num_saves, 1)
        cheap = self.newton.falls_back and self.newton.marches(problem.system, stage_scheme(scheme))
        self._cheap = replace(self.newton, method="march") if cheap else self.newton
        self.compile_seconds = float("nan")

    @cached_property
    def _compiled(self):
        return self._compile(self._cheap)

    @cached_property
    def _exact(self):
        return self._compile(self.newton)

    def _compile(self, newton):
        """The program with everything but the number of steps filled in."""
        start = time.perf_counter()
        data = self.problem.system, self.scheme, newton, self.state, self.t_end
        compiled = _from_the_start.lower(*data, 1, 1, num_saves=self.num_saves).compile()
        self.compile_seconds = time.perf_counter() - start
        return partial(compiled, *data)

    def __call__(self, num_steps: int) -> vm.Trajectory:
        """The trajectory with `num_saves` + 1 nodes.

        Raises:
            ValueError: num_steps is not a positive multiple of num_saves.
        """
        if num_steps < 1 or num_steps % self.num_saves:
            raise ValueError(
                f"Program: num_steps is {num_steps}; it must be a multiple of {self.num_saves}, at least one."
            )
        trajectory = self._compiled(num_steps, num_steps // self.num_saves)
        if self._cheap is not self.newton and int(trajectory.failed_at) >= 0:
            trajectory = self._exact(num_steps, num_steps // self.num_saves)
        return trajectory

    def timed(self, num_steps: int):
        """A function without arguments that runs and waits, for a clock; takes the fallback if the run needs it."""
        compiled = self._compiled
        if self._cheap is not self.newton and int(compiled(num_steps, num_steps // self.num_saves).failed_at) >= 0:
            compiled = self._exact
        return lambda: jax.block_until_ready(compiled(num_steps, num_steps // self.num_saves))


def joined(trajectory: vm.Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """q and p of the saved nodes, slow coordinates first."""
    return (
        np.concatenate([trajectory.q_s, trajectory.q_f], axis=-1),
        np.concatenate([trajectory.p_s, trajectory.p_f], axis=-1),
    )

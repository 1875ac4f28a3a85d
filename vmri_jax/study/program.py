"""One problem under one scheme, compiled once for every number of steps: what studies run and time."""

import time
from functools import cached_property, lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.state import Problem
from vmri_jax.running.arguments import check_run
from vmri_jax.running.trajectory import RunInfo, Trajectory
from vmri_jax.runtime import OPTIONS, in_one_kernel
from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.newton import Newton
from vmri_jax.steppers.step import start_memory

TRAJECTORY = jax.tree.structure(Trajectory(*[0.0] * 7, info=RunInfo(0, 0, 0), result=0, failed_at=0))
"""How a trajectory without micro nodes is made of its arrays."""


@lru_cache(maxsize=32)
def _compiled_for(structure, num_saves: int):
    """The compiled run of all problems of this structure: ``run_all(leaves, num_steps, save_every)``.

    It takes system, scheme, Newton, state and t_end as arrays and gives the arrays of the trajectory: bare arrays make a
    call cheap. Only the last programs are kept: thousands would exhaust the memory maps that a process may have.
    """

    @partial(jax.jit, compiler_options=OPTIONS)
    @in_one_kernel
    def run_all(leaves, num_steps, save_every):
        system, scheme, newton, state, t_end = jax.tree.unflatten(structure, leaves)
        macro_dt = t_end / num_steps
        memory = start_memory(system, scheme, state, macro_dt, newton)
        saves = 0, num_saves, save_every, False
        trajectory, _ = run(system, scheme, newton, macro_dt, state.t, state, memory, *saves)
        return jax.tree.leaves(trajectory)

    return run_all


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
        self.newton, self.state = newton or Newton(), problem.state()
        check_run(problem.system, scheme, self.state, self.newton, self.t_end / num_saves, None, num_saves, 1)
        self._alone = self.newton.alone(problem.system, scheme)
        self.compile_seconds = float("nan")

    @cached_property
    def _compiled(self):
        return self._compile(self._alone)

    @cached_property
    def _exact(self):
        return self._compile(self.newton)

    def _compile(self, newton):
        """``run(num_steps)`` that gives the arrays of the trajectory."""
        leaves, structure = jax.tree.flatten((self.problem.system, self.scheme, newton, self.state, self.t_end))
        leaves = jax.device_put([jnp.asarray(leaf) for leaf in leaves])
        run_all = _compiled_for(structure, self.num_saves)
        start = time.perf_counter()
        jax.block_until_ready(run_all(leaves, self.num_saves, 1))
        self.compile_seconds = time.perf_counter() - start  # and a run of the fewest steps
        return lambda num_steps: run_all(leaves, num_steps, num_steps // self.num_saves)

    def _chosen(self, num_steps: int):
        """The program that solves this run, and its arrays."""
        arrays = self._compiled(num_steps)
        if self._alone is self.newton or int(jax.tree.unflatten(TRAJECTORY, arrays).failed_at) < 0:
            return self._compiled, arrays
        return self._exact, self._exact(num_steps)

    def __call__(self, num_steps: int) -> Trajectory:
        """The trajectory with `num_saves` + 1 nodes.

        Raises:
            ValueError: num_steps is not a positive multiple of num_saves.
        """
        if num_steps < 1 or num_steps % self.num_saves:
            raise ValueError(f"Program: num_steps is {num_steps}; it must be a positive multiple of {self.num_saves}.")
        _, arrays = self._chosen(num_steps)
        return jax.tree.unflatten(TRAJECTORY, arrays)

    def timed(self, num_steps: int):
        """A function without arguments that runs and waits, for a clock; takes the fallback if the run needs it."""
        chosen, _ = self._chosen(num_steps)
        return lambda: chosen(num_steps)[0].block_until_ready()  # the arrays of one program are ready together


def joined(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """q and p of the saved nodes, slow coordinates first."""
    return (
        np.concatenate([trajectory.q_s, trajectory.q_f], axis=-1),
        np.concatenate([trajectory.p_s, trajectory.p_f], axis=-1),
    )

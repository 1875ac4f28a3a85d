"""The exception of a failed run, with its probable cause."""

import numpy as np

from vmri_jax.mechanics.jumps import in_words, jump_ahead
from vmri_jax.running.largest_motion import largest_motion_in_words
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.steppers.results import Result, SimulationError


def simulation_error(trajectory: Trajectory, macro_dt, save_every: int, num_micro: int) -> SimulationError:
    """The `SimulationError` of a failed run: the failing step, its status, and the largest motion before it."""
    from vmri_jax.stability.vibrations import (
        swapped_at_start,
    )  # imported here: vmri_jax.stability imports vmri_jax.running

    step = int(trajectory.failed_at)
    interval = step // save_every
    error = SimulationError(
        Result(int(trajectory.result)),
        step,
        float(trajectory.t[0] + step * macro_dt),
        int(trajectory.info.iterations[interval]),
        float(trajectory.info.residual[interval]),
        trajectory,
        moved=largest_motion_in_words(trajectory, step, save_every, float(macro_dt), num_micro),
    )
    return error.advised(float(macro_dt), swapped_at_start(trajectory), _jump(trajectory, macro_dt, save_every))


def _jump(trajectory: Trajectory, macro_dt, save_every: int) -> str:
    """A sentence about a force that jumps in the failing step or in the next one; empty where no force jumps."""
    if not trajectory.origin.knows_system or np.ndim(trajectory.t) != 1:
        return ""
    system, interval = trajectory.origin.system(), int(trajectory.failed_at) // save_every
    last = trajectory[interval]
    steps = int(trajectory.failed_at) - interval * save_every + 2
    return in_words(jump_ahead(system, last, steps * float(macro_dt)), trajectory.names)

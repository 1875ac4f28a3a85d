"""The exception of a failed run, with its probable cause."""

import numpy as np

from vmri_jax.mechanics.jumps import in_words, jump_ahead
from vmri_jax.mechanics.linearisation import linearise
from vmri_jax.running.largest_motion import largest_motion_in_words
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.steppers.results import Result, SimulationError


def simulation_error(
    trajectory: Trajectory, macro_dt, save_every: int, num_micro: int, first: int = 0, whole=None
) -> SimulationError:
    """The `SimulationError` of a failed run: the failing step, its status, and the largest motion before it.

    Args:
        trajectory: the run, or a part of it with the node before the failure.
        macro_dt, save_every, num_micro: of the run.
        first: number of the macro step that starts at the first node of `trajectory`.
        whole: the run, where `trajectory` is a part of it.
    """
    failed_at = int(trajectory.failed_at)
    step = failed_at - first
    interval = step // save_every
    error = SimulationError(
        Result(int(trajectory.result)),
        failed_at,
        float(trajectory.t[0] + step * macro_dt),
        int(trajectory.info.iterations[interval]),
        float(trajectory.info.residual[interval]),
        trajectory if whole is None else whole,
        moved=largest_motion_in_words(trajectory, step, save_every, float(macro_dt), num_micro),
    )
    return error.advised(float(macro_dt), _swapped(trajectory), _jump(trajectory, step, macro_dt, save_every))


def _swapped(trajectory: Trajectory) -> str:
    """The advice of `Linearisation.swapped` at the first node of a run; empty if its labels are right or its system is not known."""
    if not trajectory.states.q_s.shape[-1] or not trajectory.states.q_f.shape[-1]:
        return ""  # nothing to swap: the linearisation would take seconds to compile
    try:
        advice = linearise(trajectory.origin.system(), trajectory[0], trajectory.names).swapped()
    except (ValueError, TypeError, IndexError):  # no expansion at the start: the error of the run says more about it
        return ""
    return advice[0] if advice else ""


def _jump(trajectory: Trajectory, step: int, macro_dt, save_every: int) -> str:
    """A sentence about a force that jumps in the failing step or in the next one; empty where no force jumps."""
    if not trajectory.origin.knows_system or np.ndim(trajectory.t) != 1:
        return ""
    system, interval = trajectory.origin.system(), step // save_every
    steps = step - interval * save_every + 2
    return in_words(jump_ahead(system, trajectory[interval], steps * float(macro_dt)), trajectory.names)

"""Measurements of the cases: energy band and drift, constraints, reversal, refusal of single precision, one bad lane in a batch."""

import warnings
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import numpy as np

from vmri_jax import diagnostics
from vmri_jax.accuracy.companions import positions
from vmri_jax.accuracy.simulate import simulate
from vmri_jax.diagnostics.shadow import ShadowEnergy
from vmri_jax.hard_cases.case import Outcome
from vmri_jax.mechanics.constraints import rows_at
from vmri_jax.mechanics.state import Problem, State, initial_state
from vmri_jax.running.observables import LostEnergyWarning
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.schemes.scheme import fully_implicit
from vmri_jax.steppers.results import Result, SimulationError

SAVED_NODES = 10_000
"""Approximate number of saved nodes of a long run; a larger value takes more memory."""


def run(problem: Problem, scheme, macro_dt, num_steps: int, state: State | None = None, **options: Any) -> Trajectory:
    """`vmri_jax.simulate` from a state, by default the start of the problem; a failure is in the trajectory and not raised."""
    start = problem.state() if state is None else state
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LostEnergyWarning)  # the cases measure it
        try:
            return simulate(problem.system, scheme, start, macro_dt=macro_dt, num_steps=num_steps, **options)
        except SimulationError as failure:
            return failure.trajectory


def long_run(problem: Problem, scheme, macro_dt, num_steps: int, **options) -> Trajectory:
    """`run` that saves about `SAVED_NODES` nodes."""
    return run(problem, scheme, macro_dt, num_steps, save=max(1, num_steps // SAVED_NODES), **options)


def status(trajectory: Trajectory) -> str:
    """The status of a run in words."""
    name = Result(int(trajectory.result)).name
    return name if trajectory.success else f"{name} at step {int(trajectory.failed_at)}"


@dataclass(frozen=True)
class Energy:
    """Change of the energy of a run since its start.

    band: largest deviation from the start.
    drift: slope of a straight line, per 1e5 steps.
    share: change along that line over the whole run, as a share of the band.
    """

    band: float
    drift: float
    share: float

    @property
    def drifts(self) -> bool:
        """Whether the linear trend is more than half of the band: chaotic motion alone moves the mean by a tenth or two."""
        return not self.share <= 0.5


def energy(trajectory: Trajectory, num_steps: int, scale: float = 1.0) -> Energy:
    """Band and drift of the energy over a run of `num_steps` steps, in units of `scale`; infinite where the run failed."""
    e = (np.asarray(trajectory.energy) - float(trajectory.energy[0])) / scale
    if not np.isfinite(e).all():
        return Energy(np.inf, np.inf, np.inf)
    band = float(np.abs(e).max())
    change = float(np.polyfit(np.linspace(0.0, 1.0, len(e)), e, 1)[0])
    share = abs(change) / band if band else 0.0
    return Energy(band, change / num_steps * 1e5, share)


def energy_scale(problem: Problem, trajectory: Trajectory) -> float:
    """Size of the energies of a run: the larger of ``|E_0|`` and the largest kinetic energy, at least 1e-300."""
    still = problem.system.only(lambda term: term.kind != "potential")
    kinetic = jax.vmap(partial(diagnostics.energy, still))
    _, *phase = vars(trajectory.states).values()
    return max(float(np.nanmax(kinetic(*phase))), float(abs(trajectory.energy[0])), 1e-300)


def drift_meter(problem: Problem, scheme, macro_dt, num_steps: int) -> ShadowEnergy | None:
    """The shadow energy of the first steps; None where there is none: forces, constraints that depend on time, a run that failed."""
    try:
        return diagnostics.shadow_energy(problem, scheme, run(problem, scheme, macro_dt, num_steps))
    except ValueError:
        return None


def constraints(trajectory: Trajectory) -> tuple[float, float]:
    """Largest ``|g|`` and ``|G v|`` of a run; infinite where it failed."""
    if not trajectory.success:
        return np.inf, np.inf
    position, velocity = np.asarray(trajectory.constraint_residual).max(axis=0)
    return float(position), float(velocity)


def relative_constraints(problem: Problem, trajectory: Trajectory) -> float:
    """Largest ``|g|`` at the saved nodes of a run, relative to the size of its row; NaN if the run failed."""
    states = trajectory.states
    rows = jax.jit(jax.vmap(partial(rows_at, problem.system)))(states.t, states.q_s, states.q_f)
    return float(np.max(np.abs(rows.values) / rows.sizes))


def difference(a, b) -> float:
    """Largest absolute difference of two arrays; infinite if one is not finite."""
    return float(np.max(np.nan_to_num(np.abs(np.asarray(a) - np.asarray(b)), nan=np.inf), initial=0.0))


def reversal(problem: Problem, scheme, macro_dt, num_steps: int) -> float:
    """Distance from the start after `num_steps` steps forward and, with reversed momenta, `num_steps` steps back."""
    there = run(problem, scheme, macro_dt, num_steps, save=num_steps)
    if not there.success:
        return np.inf
    end = there.final_state
    turned = State(0.0, end.q_s, end.q_f, -end.p_s, -end.p_f)
    back = run(problem, scheme, macro_dt, num_steps, turned, save=num_steps)
    return difference(positions(back)[-1], positions(there)[0])


def single_precision(problem: Problem, macro_dt: float = 0.01) -> Outcome:
    """Whether a run with the 64-bit mode off, and a start with positions in float32, are refused with the line that mends them."""
    state = problem.state()
    with jax.enable_x64(False):
        off = refusal(lambda: simulate(problem.system, fully_implicit(2), state, macro_dt=macro_dt, num_steps=1))
    q_s, q_f = (np.asarray(q, np.float32) for q in (problem.q_s, problem.q_f))
    data = refusal(lambda: initial_state(problem.system, q_s, q_f, problem.v_s, problem.v_f))
    fix = 'jax.config.update("jax_enable_x64", True)' in off
    cast = "float32" in data and "astype(float)" in data
    return Outcome(
        f"64-bit mode off: {'refused with the line to add' if fix else off or 'accepted'}; float32 positions: "
        f"{'refused with the cast' if cast else data or 'accepted'}",
        fix and cast,
        {"mode_refused": fix, "data_refused": cast},
    )


def refusal(call) -> str:
    """The message of the ValueError that a call raises; empty if it raises none."""
    try:
        call()
    except ValueError as error:
        return str(error)
    return ""

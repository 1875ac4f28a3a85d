"""Measurements of several cases: runs that may fail, band and drift of the energy, constraints, refusals."""

import warnings
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import numpy as np

from vmri_jax import diagnostics
from vmri_jax.accuracy.simulate import simulate
from vmri_jax.diagnostics.shadow import ShadowEnergy
from vmri_jax.mechanics.state import Problem, State
from vmri_jax.refusals import Refused
from vmri_jax.running.observables import LostEnergyWarning
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.steppers.results import Result, SimulationError

SAVED_NODES = 10_000
"""Approximate number of saved nodes of a long run; a larger value takes more memory."""


def run(problem: Problem, scheme, macro_dt, num_steps: int, state: State | None = None, **options: Any) -> Trajectory:
    """`vmri_jax.simulate` from a state, by default the start of the problem; a failure is in the trajectory and not
    raised."""
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
        """Whether the linear trend is more than half of the band: chaotic motion moves the mean by a tenth or two."""
        return not self.share <= 0.5


def energy(trajectory: Trajectory, num_steps: int, scale: float = 1.0) -> Energy:
    """Band and drift of the energy over a run of `num_steps` steps, in units of `scale`; infinite if it failed."""
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
    """The shadow energy of the first steps; None with forces, moving constraints, or a run that failed."""
    try:
        return diagnostics.shadow_energy(problem, scheme, run(problem, scheme, macro_dt, num_steps))
    except Refused:
        return None


def constraints(trajectory: Trajectory) -> tuple[float, float]:
    """Largest ``|g|`` and ``|G v|`` of a run; infinite where it failed."""
    if not trajectory.success:
        return np.inf, np.inf
    position, velocity = np.asarray(trajectory.constraint_residual).max(axis=0)
    return float(position), float(velocity)


def difference(a, b) -> float:
    """Largest absolute difference of two arrays; infinite if one is not finite."""
    return float(np.max(np.nan_to_num(np.abs(np.asarray(a) - np.asarray(b)), nan=np.inf), initial=0.0))


def refusal(call) -> str:
    """The message of the refusal of a call; empty if the call is not refused."""
    try:
        call()
    except Refused as error:
        return str(error)
    return ""

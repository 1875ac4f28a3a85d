"""Whether a run that went through has lost its energy, as an unstable step does that does not overflow."""

import numpy as np

from vmri_jax.mechanics.masses import ConstantMass, Diagonal
from vmri_jax.running.trajectory import Trajectory


class LostEnergyWarning(UserWarning):
    """The energy of a system that keeps it has changed by half of the largest kinetic energy of a run."""


LOST = 0.5
"""Part of the largest kinetic energy: a change of the energy above it is said."""
LOOKED_AT = 1000
"""Nodes at which the kinetic energy is computed."""
ROUNDOFF = 1e-9
"""Part of the energy below which changes are not looked at."""


def lost_energy(run: Trajectory) -> str:
    """What is wrong with the energy of a run of a system that keeps it; empty where nothing is.

    Args:
        run: one run, without a failure, that knows its system; of constant masses, else nothing is said.
    """
    system = run.origin.system
    if system is None or not system.keeps_energy or not isinstance(system.kinetic, ConstantMass):
        return ""
    energy = np.asarray(run.energy)
    change = np.abs(energy - energy[0])
    worst = int(change.argmax())
    if not change[worst] > ROUNDOFF * np.abs(energy).max():
        return ""
    nodes = np.unique(np.append(np.linspace(0, len(energy) - 1, LOOKED_AT).astype(int), worst))
    slow = _kinetic(system.kinetic.slow_mass, np.asarray(run.p_s)[nodes])
    fast = _kinetic(system.kinetic.fast_mass, np.asarray(run.p_f)[nodes])
    kinetic = (slow + fast).max()
    if not change[worst] > LOST * kinetic:
        return ""
    return (
        f"the energy, which the system keeps, has changed by {change[worst]:.3g} at t = {run.t[worst]:.4g}, and the largest kinetic "
        f"energy is {kinetic:.3g}: this is no motion of the system. Take smaller steps, or ask vmri_jax.stability.advise(problem, "
        "scheme, macro_dt=...) which are stable."
    )


def _kinetic(mass, p: np.ndarray) -> np.ndarray:
    """``p M^-1 p / 2`` at every node."""
    if isinstance(mass, Diagonal):
        return (p**2 / np.asarray(mass.masses)).sum(axis=1) / 2
    return np.einsum("ki,ik->k", p, np.linalg.solve(np.asarray(mass.matrix), p.T)) / 2

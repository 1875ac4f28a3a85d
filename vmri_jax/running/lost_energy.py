"""Whether a run that went through has lost its energy, as an unstable step does that does not overflow."""

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.invariants import energy_parts
from vmri_jax.mechanics.masses import ConstantMass, Diagonal
from vmri_jax.mechanics.state import State
from vmri_jax.mechanics.system import System
from vmri_jax.running.origin import at_nodes
from vmri_jax.running.trajectory import Trajectory


class LostEnergyWarning(UserWarning):
    """The energy of a system that keeps it has changed by half of the largest kinetic energy of a run."""


LOST = 0.5
"""Part of the largest kinetic energy: a change of the energy above it is said."""
LOOKED_AT = 1000
"""Nodes at which the kinetic energy is computed."""
ROUNDOFF = 1e-9
"""Part of the kinetic energy and all potentials below which changes of their sum are round-off; a larger one hides losses of systems whose terms cancel."""
DIGITS = 10 * np.finfo(float).eps
"""Part of the largest position that a step may move positions by round-off alone; a larger one hides slower motions."""


def lost_energy(run: Trajectory, macro_dt: float) -> str:
    """What is wrong with the energy of a run of a system that keeps it; empty where nothing is.

    A system at rest moves by round-off: n steps H change velocities by up to ``sqrt(n) DIGITS |q| / H``, in random directions. A kinetic
    energy below that of such velocities, and a change below round-off of the terms that make up the energy, say nothing.

    Args:
        run: one run, without a failure, that knows its system; of constant masses, else nothing is said.
        macro_dt: step H.
    """
    if not run.origin.knows_system:
        return ""
    system = run.origin.system()
    if not system.keeps_energy or not isinstance(system.kinetic, ConstantMass):
        return ""
    energy = np.asarray(run.energy)
    change = np.abs(energy - energy[0])
    worst = int(change.argmax())
    if not change[worst] > ROUNDOFF * np.abs(energy).max():
        return ""
    nodes = np.unique(np.append(np.linspace(0, len(energy) - 1, LOOKED_AT).astype(int), worst))
    slow = _kinetic(system.kinetic.slow_mass, np.asarray(run.states.p_s)[nodes])
    fast = _kinetic(system.kinetic.fast_mass, np.asarray(run.states.p_f)[nodes])
    kinetic = (slow + fast).max()
    if not change[worst] > LOST * kinetic or not change[worst] > _kinetic_of_roundoff(run, macro_dt):
        return ""
    if not change[worst] > ROUNDOFF * np.max(at_nodes(_size_of_terms, run.origin, _states(run, nodes))):
        return ""
    return (
        f"the computed motion is wrong: the energy, which the system keeps, has changed by {change[worst]:.3g} at t = {np.asarray(run.t)[worst]:.4g}, "
        f"and the largest kinetic energy is {kinetic:.3g}. Take smaller steps, or ask vmri_jax.stability.advise(problem, "
        "scheme, macro_dt=...) which are stable."
    )


def _kinetic(mass, p: np.ndarray) -> np.ndarray:
    """``p M^-1 p / 2`` at every node."""
    if isinstance(mass, Diagonal):
        return (p**2 / np.asarray(mass.masses)).sum(axis=1) / 2
    return np.einsum("ki,ik->k", p, np.linalg.solve(np.asarray(mass.matrix), p.T)) / 2


def _kinetic_of_roundoff(run: Trajectory, macro_dt: float) -> float:
    """Kinetic energy of velocities that round-off of the positions makes in the steps of a run."""
    mass, t = run.origin.system().kinetic, np.asarray(run.t)
    steps = float(t[-1] - t[0]) / macro_dt
    position = max(np.abs(q).max(initial=0.0) for q in (np.asarray(run.states.q_s), np.asarray(run.states.q_f)))
    total = sum(float(jnp.trace(part.matrix)) for part in (mass.slow_mass, mass.fast_mass))
    return total * steps * (DIGITS * position / macro_dt) ** 2 / 2


def _states(run: Trajectory, nodes: np.ndarray) -> State:
    return jax.tree.map(lambda a: np.asarray(a)[nodes], run.states)


def _size_of_terms(system: System, state: State):
    """``|T| + |V| + |W| + sum_i |V_i|``."""
    return sum(jnp.abs(part) for part in energy_parts(system, state.q_s, state.q_f, state.p_s, state.p_f).values())

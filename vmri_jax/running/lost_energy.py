"""Check of the energy of a run whose steps all succeeded: an unstable step may change it without an overflow."""

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


REPORTED_CHANGE = 0.5
"""Change of the energy, as a part of the largest kinetic energy, above which the user is warned; a larger value misses slower instabilities."""
NODES_CHECKED = 1000
"""Most nodes at which the kinetic energy is computed; a larger number makes the check of a long run take longer."""
ROUNDOFF_OF_ENERGY = 1e-9
"""Change of the energy, as a part of the sum of the moduli of its terms, up to which it is round-off. A larger value hides losses in systems
whose terms cancel."""
ROUNDOFF_OF_STEP = 10 * np.finfo(float).eps
"""Round-off of a position in a step, as a part of the largest position; a larger value hides slower motions."""


def lost_energy(run: Trajectory, macro_dt: float) -> str:
    """A sentence about a run whose system keeps its energy and whose energy has changed; empty for any other run.

    A system at rest moves by round-off: n steps H change velocities by up to ``sqrt(n) ROUNDOFF_OF_STEP |q| / H``, in random directions. The
    check therefore ignores kinetic energies below the energy of these velocities, and changes below the round-off of the energy's terms.

    Args:
        run: one run without a failure. The result is empty unless it knows its system, and its masses are constant.
        macro_dt: macro step H.
    """
    if not run.origin.knows_system:
        return ""
    system = run.origin.system()
    if not system.keeps_energy or not isinstance(system.kinetic, ConstantMass):
        return ""
    energy = np.asarray(run.energy)
    change = np.abs(energy - energy[0])
    worst = int(change.argmax())
    # The usual case ends here, without kinetic energies.
    if not change[worst] > ROUNDOFF_OF_ENERGY * np.abs(energy).max():
        return ""
    nodes = np.unique(np.append(np.linspace(0, len(energy) - 1, NODES_CHECKED).astype(int), worst))
    slow = _kinetic(system.kinetic.slow_mass, np.asarray(run.states.p_s)[nodes])
    fast = _kinetic(system.kinetic.fast_mass, np.asarray(run.states.p_f)[nodes])
    kinetic = (slow + fast).max()
    if not change[worst] > REPORTED_CHANGE * kinetic or not change[worst] > _kinetic_of_roundoff(run, macro_dt):
        return ""
    states = jax.tree.map(lambda a: np.asarray(a)[nodes], run.states)
    if not change[worst] > ROUNDOFF_OF_ENERGY * np.max(at_nodes(_size_of_terms, run.origin, states)):
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
    """Kinetic energy ``sum_i m_i v^2 / 2`` of the velocity ``v = sqrt(n) ROUNDOFF_OF_STEP |q| / H`` that n steps make by round-off."""
    mass, t = run.origin.system().kinetic, np.asarray(run.t)
    steps = float(t[-1] - t[0]) / macro_dt
    position = max(np.abs(q).max(initial=0.0) for q in (np.asarray(run.states.q_s), np.asarray(run.states.q_f)))
    total = sum(float(jnp.trace(part.matrix)) for part in (mass.slow_mass, mass.fast_mass))
    return total * steps * (ROUNDOFF_OF_STEP * position / macro_dt) ** 2 / 2


def _size_of_terms(system: System, state: State):
    """``|T| + |V| + |W| + sum_i |V_i|``."""
    return sum(jnp.abs(part) for part in energy_parts(system, state.q_s, state.q_f, state.p_s, state.p_f).values())

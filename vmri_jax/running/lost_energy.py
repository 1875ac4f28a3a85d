"""Check of the energy of a run whose steps all succeeded: an unstable step may change it without an overflow."""

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.invariants import energy_parts
from vmri_jax.mechanics.masses import ConstantMass
from vmri_jax.mechanics.state import State
from vmri_jax.mechanics.system import System
from vmri_jax.running.origin import at_nodes
from vmri_jax.running.trajectory import Trajectory


class LostEnergyWarning(UserWarning):
    """The energy of a system with constant masses that keeps it has changed by more than half of the largest kinetic energy of a run."""


REPORTED_CHANGE = 0.5
"""Change of the energy, as a part of the largest kinetic energy, above which the user is warned; a larger value misses slower instabilities."""
NODES_CHECKED = 1000
"""Most nodes at which the kinetic energy is computed; a larger number makes the check of a long run take longer."""
ROUNDOFF_OF_ENERGY = 1e-9
"""Change of the energy, as a part of the sum of the moduli of its terms, up to which it is round-off. A larger value hides losses in systems
whose terms cancel."""
ROUNDOFF_OF_STEP = 10 * np.finfo(float).eps
"""Round-off of a position in a step, as a part of the largest position; a larger value hides slower motions."""


def lost_energy(run: Trajectory, system: System, macro_dt: float) -> str:
    """A sentence about a run whose system keeps its energy and whose energy has changed; empty for any other run.

    A system at rest moves by round-off: n steps H change velocities by up to ``sqrt(n) ROUNDOFF_OF_STEP |q| / H``, in random directions. The
    check therefore ignores kinetic energies below the energy of these velocities, and changes below the round-off of the energy's terms.

    Args:
        run: one run without a failure.
        system: its system. The result is empty unless its masses are constant.
        macro_dt: macro step H.
    """
    if not system.keeps_energy or not isinstance(system.kinetic, ConstantMass):
        return ""
    energy = np.asarray(run.energy)
    change = np.abs(energy - energy[0])
    worst = int(change.argmax())
    # The usual case ends here, without kinetic energies.
    if not change[worst] > ROUNDOFF_OF_ENERGY * np.abs(energy).max():
        return ""
    nodes = np.unique(np.append(np.linspace(0, len(energy) - 1, NODES_CHECKED).astype(int), worst))
    slow = _kinetic(np.asarray(system.kinetic.slow), np.asarray(run.states.p_s)[nodes])
    fast = _kinetic(np.asarray(system.kinetic.fast), np.asarray(run.states.p_f)[nodes])
    kinetic = (slow + fast).max()
    if not change[worst] > REPORTED_CHANGE * kinetic or not change[worst] > _kinetic_of_roundoff(
        run, system.kinetic, macro_dt
    ):
        return ""
    states = jax.tree.map(lambda a: np.asarray(a)[nodes], run.states)
    if not change[worst] > ROUNDOFF_OF_ENERGY * np.max(at_nodes(_size_of_terms, run.origin, states)):
        return ""
    return (
        f"the computed motion is wrong: the energy, which the system keeps, has changed by {change[worst]:.3g} at t = {np.asarray(run.t)[worst]:.4g}, "
        f"and the largest kinetic energy is {kinetic:.3g}. Take smaller steps, or ask vmri_jax.stability.advise(problem, "
        "scheme, macro_dt=...) which are stable."
    )


def _kinetic(mass: np.ndarray, p: np.ndarray) -> np.ndarray:
    """``p M^-1 p / 2`` at every node; the mass matrix M is given by its diagonal (n,) or whole (n, n).

    In NumPy: `ConstantMass.velocity` would add a tenth to the time of a short run.
    """
    if mass.ndim == 1:
        return (p**2 / mass).sum(axis=1) / 2
    return np.einsum("ki,ik->k", p, np.linalg.solve(mass, p.T)) / 2


def _kinetic_of_roundoff(run: Trajectory, mass: ConstantMass, macro_dt: float) -> float:
    """Kinetic energy ``sum_i m_i v^2 / 2`` of the velocity ``v = sqrt(n) ROUNDOFF_OF_STEP |q| / H`` that n steps make by round-off."""
    t = np.asarray(run.t)
    steps = float(t[-1] - t[0]) / macro_dt
    position = max(np.abs(q).max(initial=0.0) for q in (np.asarray(run.states.q_s), np.asarray(run.states.q_f)))
    total = sum(float(np.sum(part if np.ndim(part) == 1 else np.trace(part))) for part in (mass.slow, mass.fast))
    return total * steps * (ROUNDOFF_OF_STEP * position / macro_dt) ** 2 / 2


def _size_of_terms(system: System, state: State):
    """``|T| + |V| + |W| + sum_i |V_i|``."""
    return sum(jnp.abs(part) for part in energy_parts(system, state.q_s, state.q_f, state.p_s, state.p_f).values())

"""Quantities that a trajectory conserves: energy, momentum maps, constraints; and velocities."""

import jax.numpy as jnp

from vmri_jax.mechanics.arrays import split_at
from vmri_jax.mechanics.projection import have_closed_masses, project_momentum
from vmri_jax.mechanics.slopes import slopes_at
from vmri_jax.mechanics.state import State
from vmri_jax.mechanics.system import System


def energy_parts(system: System, q_s, q_f, p_s, p_f, velocities=None, masses=None) -> dict:
    """Parts of the Hamiltonian ``p . v - T(q, v) + V + W + sum_i V_i``: "kinetic", "slow", "fast" and the names of
    `System.potentials`.

    Velocities (v_s, v_f) of the momenta and masses (n, n) that are known already are not computed again.
    """
    v_s, v_f = velocities or velocity(system, q_s, q_f, p_s, p_f)
    if masses is not None and have_closed_masses(system.of_kind("kinetic")):
        v = jnp.concatenate([v_s, v_f])
        energy_of_motion = v @ masses @ v / 2
    else:
        energy_of_motion = system.kinetic_energy(q_s, q_f, v_s, v_f)
    kinetic = jnp.sum(p_s * v_s) + jnp.sum(p_f * v_f) - energy_of_motion
    return {"kinetic": kinetic, **system.all_potentials(q_s, q_f)}


def potential_energy(system: System, q_s, q_f):
    """``V + W + sum_i V_i``."""
    return sum(system.all_potentials(q_s, q_f).values())


def lagrangian(system: System, n_s: int, q, v):
    """``T - V - W - sum_i V_i`` at positions and velocities (n_s + n_f,)."""
    q_s, q_f = split_at(q, n_s)
    return system.kinetic_energy(q_s, q_f, *split_at(v, n_s)) - potential_energy(system, q_s, q_f)


def energy(system: System, q_s, q_f, p_s, p_f):
    """Hamiltonian ``p . v - T(q, v) + V(q_s, q_f) + W(q_f) + sum_i V_i(q_s, q_f)`` with v the velocity of p.

    Args:
        system: masses, potentials and their parameters.
        q_s, q_f: (n_s,) and (n_f,) positions.
        p_s, p_f: (n_s,) and (n_f,) momenta.
    """
    return sum(energy_parts(system, q_s, q_f, p_s, p_f).values())


def oscillatory_energies(omega, q_f, p_f):
    """Energies ``I_i = (p_fi^2 + omega^2 q_fi^2) / 2`` of unit-mass harmonic oscillators, e.g. the stiff FPU springs.

    Args:
        omega: frequency of all oscillators, or one frequency for each.
        q_f, p_f: positions and momenta of the oscillators.
    """
    return (p_f**2 + omega**2 * q_f**2) / 2


def constraint_residual(system: System, state: State, velocities=None):
    """Largest ``|g|`` (position level) and largest ``|G v + dg/dt|`` (velocity level), shape (2,).

    Args:
        system: with its constraints and the implied rows; without both the result is zero.
        state: time, positions and momenta.
        velocities: (v_s, v_f) of the momenta if they are known.
    """
    velocities = velocities or velocity(system, state.q_s, state.q_f, state.p_s, state.p_f)
    return slopes_at(system, state.t, state.q_s, state.q_f).residual(jnp.concatenate(velocities))


def all_constraints(system: System, state: State, velocities=None):
    """Constraints and hidden constraints, ``(g, G v + dg/dt)``, each (n_g + n_gs,): zero on the constraint manifold."""
    velocities = velocities or velocity(system, state.q_s, state.q_f, state.p_s, state.p_f)
    configuration = state.t, state.q_s, state.q_f
    return system.constraints(*configuration), system.constraint_rates(*configuration, *velocities)


def velocity(system: System, q_s, q_f, p_s, p_f):
    """Velocities ``(v_s, v_f)`` of momenta (inverse Legendre transform, constraints ignored).

    Args:
        system: with its kinetic energy.
        q_s, q_f: (n_s,) and (n_f,) positions, for masses that depend on them.
        p_s, p_f: (n_s,) and (n_f,) momenta.
    """
    return velocity_and_masses(system, q_s, q_f, p_s, p_f)[0]


def velocity_and_masses(system: System, q_s, q_f, p_s, p_f):
    """`velocity`, and the mass matrix ``d^2 T / dv^2`` (n, n); None for constant masses."""
    state, none = State(jnp.zeros(()), q_s, q_f, p_s, p_f), (jnp.zeros((0, q_s.size + q_f.size)), jnp.zeros(0))
    _, _, v_s, v_f, masses = project_momentum(system, state, constraints=none)
    return (v_s, v_f), masses


def momentum_map(generator, q_s, q_f, p_s, p_f):
    """Momentum map ``p . xi(q)`` of a symmetry.

    Args:
        generator: its infinitesimal generator, ``generator(q_s, q_f) -> (xi_s, xi_f)``.
        q_s, q_f, p_s, p_f: positions and momenta.
    """
    xi_s, xi_f = generator(q_s, q_f)
    return p_s @ xi_s + p_f @ xi_f


def rotation_about(axis):
    """Generator of rotations of points in R^3 about an axis (3,) through the origin, ``xi(q) = axis x q``."""
    axis = jnp.asarray(axis, dtype=float)

    def generator(q_s, q_f):
        return tuple(jnp.cross(axis, q.reshape(-1, 3)).reshape(-1) for q in (q_s, q_f))

    return generator


def translation_along(direction):
    """Generator of translations of points in R^3, ``xi(q) = direction`` (3,) for every point."""
    direction = jnp.asarray(direction, dtype=float)

    def generator(q_s, q_f):
        return tuple(jnp.tile(direction, q.shape[0] // 3) for q in (q_s, q_f))

    return generator

"""The continuous equations of motion at one state: accelerations, and the multipliers of the constraints.

    d/dt dT/dv = dL/dq + F - G^T lambda      d2/dt2 g(t, q) = 0

With the mass matrix ``M = d2T/dv2`` these are linear in the accelerations a and the multipliers,

    [M, G^T; G, 0] (a, lambda) = (dL/dq + F - (dp/dq) v,  -gamma)

where gamma is the second derivative of g in time without acceleration.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from vmri_jax.kernels.saddle import least_norm
from vmri_jax.mechanics.arrays import split_at
from vmri_jax.mechanics.invariants import lagrangian, velocity, velocity_and_masses
from vmri_jax.mechanics.projection import time_rates
from vmri_jax.mechanics.state import State
from vmri_jax.mechanics.system import System


class Motion(NamedTuple):
    """Velocities, accelerations and multipliers of a state.

    v_s, v_f: velocities.
    a_s, a_f: accelerations.
    multipliers: (n_g + n_gs,) lambda of `constraint` and of `slow_constraint`, joined.
    """

    v_s: Any
    v_f: Any
    a_s: Any
    a_f: Any
    multipliers: Any


def force_of(lagrangian, q, v):
    """Force ``dL/dq - d2L/dvdq v`` (n,) of a Lagrangian ``L(q, v)`` at constant velocities."""
    by_q, by_v = (jax.grad(lagrangian, argument) for argument in (0, 1))
    return by_q(q, v) - jax.jvp(lambda q: by_v(q, v), (q,), (v,))[1]


def motion(system: System, state: State) -> Motion:
    """Velocities, accelerations and multipliers of a state; of dependent constraints the least multipliers."""
    n_s = state.q_s.size
    (v_s, v_f), mass = velocity_and_masses(system, state.q_s, state.q_f, state.p_s, state.p_f)
    mass = system.kinetic.matrix if mass is None else mass
    q, v = jnp.append(state.q_s, state.q_f), jnp.append(v_s, v_f)

    def constraints(t, q):
        return system.constraints(t, *split_at(q, n_s))

    def rates(t, q):
        """``dg/dt`` along the velocities."""
        return jax.jvp(constraints, (t, q), (jnp.ones_like(t), v))[1]

    t = jnp.asarray(state.t)
    of_motion = partial(lagrangian, system, n_s)
    forces = force_of(of_motion, q, v) + jnp.concatenate(system.forces(t, state.q_s, state.q_f, v_s, v_f))
    jacobian = jax.jacrev(constraints, argnums=1)(t, q)
    gamma = jax.jvp(rates, (t, q), (jnp.ones_like(t), v))[1]

    # a = free - responses lambda with free = M^-1 forces, responses = M^-1 G^T; G a = -gamma gives lambda
    free, responses = jnp.linalg.solve(mass, forces), jnp.linalg.solve(mass, jacobian.T)
    multipliers = least_norm(jacobian @ responses, jacobian @ free + gamma)
    a = free - responses @ multipliers
    return Motion(v_s, v_f, *split_at(a, n_s), multipliers)


def reaction_forces(system: System, node: tuple[State, Any]):
    """Forces ``-G^T lambda`` (m, n_s + n_f) of m constraints, and (m, n_s + n_f) whether each acts on each coordinate.

    Args:
        node: the state, and (m, rows) for each of them which rows of `constraint` and `slow_constraint`, joined, are
            its rows: values and no part of the program, so that one program computes the forces of every constraint.
    """
    state, chosen = node
    jacobians = jax.jacrev(system.constraints, argnums=(1, 2))(state.t, state.q_s, state.q_f)
    jacobian, multipliers = jnp.concatenate(jacobians, axis=1), motion(system, state).multipliers
    forces = -jnp.where(chosen, multipliers, 0.0) @ jacobian
    return forces, jnp.any(jnp.asarray(chosen)[:, :, None] & (jacobian != 0), axis=1)


def powers(system: System, state: State):
    """Powers (2,) that change the energy: of forces, ``F . v``, and of constraints that depend on time,
    ``lambda . dg/dt``."""
    of_forces = of_constraints = jnp.zeros(())
    if system.force is not None:
        v_s, v_f = velocity(system, state.q_s, state.q_f, state.p_s, state.p_f)
        f_s, f_f = system.forces(state.t, state.q_s, state.q_f, v_s, v_f)
        of_forces = jnp.sum(f_s * v_s) + jnp.sum(f_f * v_f)
    if system.is_rheonomic:
        rates = time_rates(system, state.t, state.q_s, state.q_f)
        of_constraints = jnp.sum(motion(system, state).multipliers * rates)
    return jnp.stack([of_forces, of_constraints])

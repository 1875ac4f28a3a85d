"""Equations of motion for the peers that take any right-hand side, by hand, in their fastest form."""

import jax.numpy as jnp
import numpy as np

from benchmarks.peers.cases import Case
from benchmarks.peers.mechanics import chain_accelerations


def acceleration(case: Case):
    """``a(q, v)``, arrays (n,), in JAX; of particles coordinate by coordinate, which XLA makes one kernel of."""
    if not case.is_chain:
        return lambda q, v: jnp.stack(case.particles.accelerations(list(q), list(v), jnp.sqrt))
    if case.q.size <= 12:
        return lambda q, v: jnp.stack(chain_accelerations(list(q), case.omega))

    def chain(q, v):
        cubes, f = gaps(q) ** 3, q[q.size // 2 :]
        return jnp.concatenate([cubes[1:] - cubes[:-1], cubes[:-1] + cubes[1:] - case.omega**2 * f])

    return chain


def gaps(q):
    """`chain_gaps` over arrays."""
    s, f = jnp.split(q, 2)
    wall = jnp.zeros(1)
    return jnp.concatenate([s - f, wall]) - jnp.concatenate([wall, s + f])


def chain_potential(q, omega):
    """``V + W`` of a chain."""
    return jnp.sum(gaps(q) ** 4) / 4 + omega**2 / 2 * jnp.sum(q[q.size // 2 :] ** 2)


def energy(case: Case) -> float:
    """Of the start."""
    if not case.is_chain:
        return case.particles.energy(case.q, case.v)
    return float(np.sum(case.v**2) / 2 + chain_potential(case.q, case.omega))

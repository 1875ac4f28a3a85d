"""Equations of motion for the peers that take any right-hand side, written by hand, in the form that runs fastest."""

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
        s, f = jnp.split(q, 2)
        wall = jnp.zeros(1)
        cubes = (jnp.concatenate([s - f, wall]) - jnp.concatenate([wall, s + f])) ** 3
        return jnp.concatenate([cubes[1:] - cubes[:-1], cubes[:-1] + cubes[1:] - case.omega**2 * f])

    return chain


def energy(case: Case) -> float:
    """Of the start, in numpy."""
    if not case.is_chain:
        return case.particles.energy(case.q, case.v)
    s, f = np.split(case.q, 2)
    gaps = np.append(s - f, 0.0) - np.insert(s + f, 0, 0.0)
    return float(np.sum(case.v**2) / 2 + np.sum(gaps**4) / 4 + case.omega**2 / 2 * np.sum(f**2))

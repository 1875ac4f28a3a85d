# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
"""JAX MD: velocity Verlet (`simulate.nve`); it has no constraints and no multirate integrator."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax_md import quantity, simulate, space

from benchmarks.peers.cases import Case, Ladder, NotRepresentable
from benchmarks.peers.equations import chain_potential


def ladders(case: Case) -> list[Ladder]:
    """Powers of two of steps: JAX MD rounds the step to single precision, which these survive."""
    if not case.is_chain:
        raise NotRepresentable("JAX MD has no constraints")
    initial, step = prepare(case)

    @jax.jit
    def steps(state, dt, num_steps):
        state = jax.lax.fori_loop(0, num_steps, lambda _, s: step(s, dt=dt), state)
        return state.position[:, 0]

    def build(num_steps: int):
        return partial(steps, initial(), jnp.asarray(case.t_end / num_steps), jnp.asarray(num_steps))

    first = int(np.ceil(np.log2(16 * case.t_end)))
    return [Ladder("velocity Verlet", "steps", [2**k for k in range(first, first + 20)], build)]


def prepare(case: Case):
    """``initial()`` and ``step(state, dt)``."""
    _, shift = space.free()
    create, step = simulate.nve(partial(potential, omega=case.omega), shift)
    q, v = jnp.asarray(case.q)[:, None], jnp.asarray(case.v)[:, None]

    def initial() -> Any:
        return create(jax.random.PRNGKey(0), q, 0.0, mass=1.0, momenta=v)

    return initial, step


def potential(positions, omega, **_):
    """Of a chain whose coordinates are particles on a line."""
    return chain_potential(positions[:, 0], omega)


def energy(case: Case) -> float:
    """Of the start: JAX MD's kinetic energy and the potential."""
    initial, _ = prepare(case)
    state = initial()
    kinetic = quantity.kinetic_energy(momentum=state.momentum, mass=state.mass)
    return float(kinetic + potential(state.position, case.omega))

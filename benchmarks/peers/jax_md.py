# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
"""JAX MD: velocity Verlet at constant energy (`simulate.nve`); it has no constraints and no multirate integrator."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax_md import quantity, simulate, space

from benchmarks.peers.cases import Case, Ladder, NotRepresentable


def ladders(case: Case) -> list[Ladder]:
    """Powers of two of steps: JAX MD rounds the step to single precision, which these survive.

    Raises:
        NotRepresentable: there are constraints.
    """
    if not case.is_chain:
        raise NotRepresentable("JAX MD has no constraints")
    initial, step, start = prepare(case)

    @jax.jit
    def steps(state, dt, num_steps):
        state = jax.lax.fori_loop(0, num_steps, lambda _, s: step(s, dt=dt), state)
        return state.position[:, 0]

    def build(num_steps: int):
        state = initial(*start)
        return partial(steps, state, jnp.asarray(case.t_end / num_steps), jnp.asarray(num_steps))

    first = int(np.ceil(np.log2(16 * case.t_end)))
    return [Ladder("velocity Verlet", "steps", [2**k for k in range(first, first + 20)], build)]


def prepare(case: Case):
    """``initial(q, v)``, ``step(state, dt)`` and the start."""
    _, shift = space.free()
    create, step = simulate.nve(partial(potential, omega=case.omega), shift)

    def initial(q, v) -> Any:
        return create(jax.random.PRNGKey(0), q, 0.0, mass=1.0, momenta=v)

    return initial, step, (jnp.asarray(case.q)[:, None], jnp.asarray(case.v)[:, None])


def potential(positions, omega, **_):
    """``V + W`` of a chain whose coordinates are particles on a line."""
    s, f = jnp.split(positions[:, 0], 2)
    wall = jnp.zeros(1)
    gaps = jnp.concatenate([s - f, wall]) - jnp.concatenate([wall, s + f])
    return jnp.sum(gaps**4) / 4 + omega**2 / 2 * jnp.sum(f**2)


def energy(case: Case) -> float:
    """Of the start: JAX MD's kinetic energy and the potential."""
    initial, _, start = prepare(case)
    state = initial(*start)
    kinetic = quantity.kinetic_energy(momentum=state.momentum, mass=state.mass)
    return float(kinetic + potential(state.position, case.omega))

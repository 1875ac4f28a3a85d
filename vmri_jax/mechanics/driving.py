"""Explicit time in a system: forces and moving constraints that drive it."""

from functools import partial

import jax.numpy as jnp

from vmri_jax.mechanics.functions import Rheonomic
from vmri_jax.mechanics.structure import depends_on
from vmri_jax.mechanics.system import System


def driven(system: System, state) -> tuple[str, ...]:
    """Names of the terms of a system that depend explicitly on time: "force", "constraint", "slow_constraint".

    The operations of the traced functions decide, whatever their values: ``jnp.where(t > 2, F, 0)`` depends on time, also before t = 2; a
    `Rheonomic` function that does not use t does not. Nothing is computed, so that state and params may be traced.

    Args:
        state: a `State`, or any object with arrays q_s (n_s,) and q_f (n_f,).
    """
    q_s, q_f = state.q_s, state.q_f
    terms = {}
    if system.force is not None:
        terms["force"] = partial(system.forces, q_s=q_s, q_f=q_f, v_s=jnp.zeros_like(q_s), v_f=jnp.zeros_like(q_f))
    if isinstance(system.constraint, Rheonomic):
        terms["constraint"] = partial(system.g, q_s=q_s, q_f=q_f)
    if isinstance(system.slow_constraint, Rheonomic):
        terms["slow_constraint"] = partial(system.g_slow, q_s=q_s)
    return tuple(name for name, value in terms.items() if depends_on(value, jnp.zeros(()))[0])

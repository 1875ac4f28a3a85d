"""How the bodies of a scene move at one state, by its continuous equations."""

import jax
import jax.numpy as jnp

from vmri_jax.mechanics.motion import motion
from vmri_jax.mechanics.projection import legendre
from vmri_jax.mechanics.state import State


def state_of(scene):
    """The state at the start, of velocities that keep all constraints."""
    system, (q_s, q_f, v_s, v_f) = scene.system(), scene.start
    return State(jnp.zeros(()), q_s, q_f, *jax.jit(legendre)(system, q_s, q_f, v_s, v_f))


def accelerations(scene, state):
    """Positions, velocities and accelerations of all bodies by name."""
    moved = jax.jit(motion)(scene.system(), state)
    q, v, a = (state.q_s, state.q_f), (moved.v_s, moved.v_f), (moved.a_s, moved.a_f)
    layout, joints = scene.sorting.layout, scene.sorting.joints
    if layout.kinematics is not None:

        @jax.jit
        def of_bodies(q, v, a):
            def velocities(q, v):
                return layout.kinematics.velocities(*q, *v, joints)

            return layout.kinematics(*q, joints), *jax.jvp(velocities, (q, v), (v, a))

        q, v, a = of_bodies(q, v, a)
    return {
        name: tuple(both[part == "f"][start : start + size] for both in (q, v, a))
        for name, (part, start, size) in layout.bodies.items()
    }

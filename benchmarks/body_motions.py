"""Accelerations of the bodies of a scene at a state, by its continuous equations of motion."""

from typing import Any

import jax
import jax.numpy as jnp

from vmri_jax.mechanics.motion import motion
from vmri_jax.mechanics.projection import legendre
from vmri_jax.mechanics.state import State
from vmri_jax.scene.functions import UNCHANGED
from vmri_jax.scene.scene import Scene


def state_of(scene: Scene) -> State:
    """The state at the start, whose velocities must satisfy all constraints."""
    system, (q_s, q_f, v_s, v_f) = scene.system(), scene.start
    return State(jnp.zeros(()), q_s, q_f, *jax.jit(legendre)(system, q_s, q_f, v_s, v_f))


def accelerations(scene: Scene, state: State) -> dict[str, tuple[jax.Array, jax.Array, jax.Array]]:
    """Position, velocity and acceleration of every body by name: (d,) each for a point, (12,) for a rigid body, its
    centre and directors.

    Args:
        scene: with joint coordinates or directors.
        state: of the scene.
    """
    derivatives = jax.jit(motion)(scene.system(), state)
    q, v, a = (state.q_s, state.q_f), (derivatives.v_s, derivatives.v_f), (derivatives.a_s, derivatives.a_f)
    layout, joints = scene.sorting.layout, scene.sorting.joints
    kinematics: Any = layout.kinematics or UNCHANGED

    def velocities(q, v):
        return kinematics.velocities(*q, *v, joints)

    # of coordinates x: positions q(x), velocities q' v, accelerations d/dt (q' v)
    motions = jax.jit(lambda q, v, a: (kinematics(*q, joints), *jax.jvp(velocities, (q, v), (v, a))))(q, v, a)
    return {
        name: tuple(slow_and_fast[part == "f"][start : start + size] for slow_and_fast in motions)
        for name, (part, start, size) in layout.bodies.items()
    }

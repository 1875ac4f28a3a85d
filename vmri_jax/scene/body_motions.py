"""How the bodies of a scene move at one state, by its continuous equations of motion."""

import jax
import jax.numpy as jnp

from vmri_jax.mechanics.motion import motion
from vmri_jax.mechanics.projection import legendre
from vmri_jax.mechanics.state import State
from vmri_jax.scene.scene import Scene


def state_of(scene: Scene) -> State:
    """The state at the start, of velocities that keep all constraints."""
    system, (q_s, q_f, v_s, v_f) = scene.system(), scene.start
    return State(jnp.zeros(()), q_s, q_f, *jax.jit(legendre)(system, q_s, q_f, v_s, v_f))


def accelerations(scene: Scene, state: State) -> dict[str, tuple[jax.Array, jax.Array, jax.Array]]:
    """Positions, velocities and accelerations of all bodies by name.

    Each is a vector of the size of the body: (d,) of a point; (12,) of a rigid body, its centre of mass and its three directors.
    """
    moved = jax.jit(motion)(scene.system(), state)
    q, v, a = (state.q_s, state.q_f), (moved.v_s, moved.v_f), (moved.a_s, moved.a_f)
    layout, joints = scene.sorting.layout, scene.sorting.joints
    kinematics = layout.kinematics
    if kinematics is not None:  # joint coordinates x: positions q(x), velocities q' v, accelerations d/dt (q' v)

        @jax.jit
        def of_bodies(q, v, a):
            def velocities(q, v):
                return kinematics.velocities(*q, *v, joints)  # pyright: ignore[reportCallIssue]

            return kinematics(*q, joints), *jax.jvp(velocities, (q, v), (v, a))  # pyright: ignore[reportCallIssue]

        q, v, a = of_bodies(q, v, a)
    return {
        name: tuple(both[part == "f"][start : start + size] for both in (q, v, a))
        for name, (part, start, size) in layout.bodies.items()
    }

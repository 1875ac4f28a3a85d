"""Small constrained systems in the plane."""

import jax.numpy as jnp
import numpy as np

from vmri_jax import ConstantMass, Problem, State, System, initial_state


def weight(q_s, q_f, params):
    return params["gravity"] * (5.0 * q_s[1] + q_f[1])


def spring_to_the_ground(q_f, params):
    return params["stiffness"] / 2 * (jnp.linalg.norm(q_f - jnp.array([0.0, -4.0])) - 1.0) ** 2


def first_rod(q_s, params):
    return (jnp.sum(q_s**2, keepdims=True) - 1.0) / 2


def second_rod(q_s, q_f, params):
    return (jnp.sum((q_f - q_s) ** 2, keepdims=True) - 1.0) / 2


def double_pendulum(gravity=10.0, stiffness=400.0) -> System:
    """Two bobs on rods of length 1, the second one tied to the ground by a spring that pulls."""
    params = {"gravity": np.asarray(gravity), "stiffness": np.asarray(stiffness)}
    return System(
        ConstantMass([5.0, 5.0], [1.0, 1.0]), weight, spring_to_the_ground, second_rod, first_rod, params=params
    )


def hanging(system: System, up: float = -1.0) -> State:
    """At rest, the rods straight down, or up."""
    rest = [0.0, 0.0]
    return initial_state(system, [0.0, up], [0.0, 2 * up], rest, rest)


def swinging() -> Problem:
    """The two bobs in motion."""
    return Problem(double_pendulum(), *np.array([[0.6, -0.8], [0.6, -1.8], [0.4, 0.3], [-0.5, 0.3]]))

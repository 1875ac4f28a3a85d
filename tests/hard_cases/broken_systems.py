"""Systems that are broken on purpose, each in one way: what `vmri check` has to find."""

import jax
import jax.numpy as jnp

from tests.user_systems import soft_coupling
from vmri_jax import ConstantMass, Problem, System


@jax.custom_jvp
def hand_made(q_f):
    return 200.0 * jnp.sum(q_f**4)


@hand_made.defjvp
def _forgotten_factor(primals, tangents):
    (q_f,), (v_f,) = primals, tangents
    return hand_made(q_f), jnp.sum(200.0 * q_f**3 * v_f)  # 4 is forgotten


def stiff_and_wrong(q_f, params):
    return 50.0 * jnp.sum(q_f**2) + hand_made(q_f)


def wound_spring(q_f, params):
    """Turns in the plane as if it was driven: the force ``(q_1, -q_0)`` has no potential."""
    turned = jax.lax.stop_gradient(jnp.array([-q_f[1], q_f[0]]))
    return 50.0 * jnp.sum(q_f**2) + 2.0 * jnp.sum(turned * q_f)


def stiff_slow_spring(q_s, q_f, params):
    return params["kappa"] / 2 * jnp.sum((q_s - q_f) ** 2) + params["omega"] ** 2 / 2 * jnp.sum(q_s**2)


def _problem(system: System, n_s: int, n_f: int) -> Problem:
    return Problem(system, jnp.full(n_s, 0.4), jnp.full(n_f, 0.3), jnp.zeros(n_s), jnp.linspace(0.5, 1.0, n_f))


def wrong_gradient() -> Problem:
    """A derivative of one's own that forgets a factor."""
    system = System(ConstantMass([2.0], [1.0]), soft_coupling, stiff_and_wrong, params={"kappa": 1.0})
    return _problem(system, 1, 1)


def no_potential() -> Problem:
    """Forces that no potential has."""
    system = System(ConstantMass([2.0], [1.0, 1.0]), soft_coupling, wound_spring, params={"kappa": 1.0})
    return _problem(system, 1, 2)


def swapped_labels() -> Problem:
    """What is stiff is called slow, and what is soft fast."""
    params = {"kappa": 1.0, "omega": 50.0}
    return _problem(System(ConstantMass([1.0], [1.0]), stiff_slow_spring, params=params), 1, 1)

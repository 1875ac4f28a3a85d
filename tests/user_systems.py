"""Systems as users write them: plain functions of slow and fast variables."""

import jax.numpy as jnp
import numpy as np

from vmri_jax import ConstantMass, Problem, Rheonomic, State, System, initial_state


# --- one slow and one fast oscillator, coupled by a soft spring ------------------------------------------------------
def soft_coupling(q_s, q_f, params):
    return params["kappa"] / 2 * jnp.sum((q_s - q_f) ** 2)


def stiff_spring(q_f, params):
    return params["omega"] ** 2 / 2 * jnp.sum(q_f**2)


def two_oscillators(kappa=25.0, omega=50.0) -> Problem:
    system = System(
        ConstantMass([1.0], [1.0]),
        slow_potential=soft_coupling,
        fast_potential=stiff_spring,
        params={"kappa": np.asarray(kappa), "omega": np.asarray(omega)},
    )
    one = np.ones(1)
    return Problem(system, one, one / omega, 0 * one, one)


# --- double pendulum in angles: heavy long arm slow, light short arm fast --------------------------------------------
def arms_kinetic(q_s, q_f, v_s, v_f, params):
    (m_1, m_2), (l_1, l_2) = params["masses"], params["lengths"]
    coupling = m_2 * l_1 * l_2 * v_s[0] * v_f[0] * jnp.cos(q_s[0] - q_f[0])
    return (m_1 + m_2) / 2 * l_1**2 * v_s[0] ** 2 + m_2 / 2 * l_2**2 * v_f[0] ** 2 + coupling


def arms_weight(q_s, q_f, params):
    (m_1, m_2), (l_1, l_2) = params["masses"], params["lengths"]
    return -params["gravity"] * ((m_1 + m_2) * l_1 * jnp.cos(q_s[0]) + m_2 * l_2 * jnp.cos(q_f[0]))


def double_pendulum() -> Problem:
    params = {"masses": np.array([10.0, 0.1]), "lengths": np.array([1.0, 0.02]), "gravity": np.asarray(9.81)}
    system = System(arms_kinetic, slow_potential=arms_weight, params=params)
    return Problem(system, np.array([1.0]), np.array([1.3]), np.array([0.0]), np.array([2.0]))


# --- everything at once ----------------------------------------------------------------------------------------------
def bent_kinetic(q_s, q_f, v_s, v_f, params):
    coupling = params["b"] * v_s[0] * v_f[1] * jnp.cos(q_s[1] - q_f[0])
    return jnp.sum(v_s**2 * (1 + 0.3 * q_s**2)) / 2 + jnp.sum(v_f**2 * (1 + 0.1 * jnp.sin(q_f))) / 4 + coupling


def bent_slow(q_s, q_f, params):
    return jnp.sum(jnp.cosh(q_s - q_f)) + q_s[0] ** 2 * q_f[2]


def bent_fast(q_f, params):
    return params["k"] / 2 * (jnp.linalg.norm(q_f) - 1.2) ** 2


def bent_constraint(q_s, q_f, params):
    return jnp.stack([jnp.sum((q_f - q_s) ** 2) - params["length"], q_f[0] * q_f[1] - 0.1 * q_s[2] ** 2])


def bent_slow_constraint(q_s, params):
    return jnp.sum(q_s**2, keepdims=True) - 1.0


def bent_force(t, q_s, q_f, v_s, v_f, params):
    return -0.2 * v_s + jnp.sin(t) * q_f, -0.3 * v_f * jnp.sum(q_s**2) - 0.1 * v_s


def bent_system() -> System:
    """Configuration-dependent kinetic energy, coupling and slow constraints, and a force, all nonlinear."""
    return System(
        bent_kinetic,
        slow_potential=bent_slow,
        fast_potential=bent_fast,
        constraint=bent_constraint,
        slow_constraint=bent_slow_constraint,
        force=bent_force,
        params={"k": np.asarray(40.0), "b": np.asarray(0.1), "length": np.asarray(2.0)},
    )


FULL_MASS = ConstantMass(np.array([[5.0, 1.0], [1.0, 4.0]]), np.array([[1.0, 0.2, 0], [0.2, 1.0, 0.1], [0, 0.1, 2.0]]))
"""For two slow and three fast variables."""


def lifted(t, q_s, q_f, params):
    """Two constraints of these, the first one moved."""
    return jnp.stack([jnp.sum(q_f[:2] ** 2) - 1 - 0.1 * jnp.sin(t), q_f[2] - q_s[0] - q_f[0]])


def sphere(q_s, params):
    """The slow variables on a circle."""
    return jnp.sum(q_s**2, keepdims=True) - 1.0


# --- a full mass matrix and constraints of all kinds -----------------------------------------------------------------
def tilted(q_s, q_f, params):
    return params * (q_s[1] + q_f[1]) + jnp.sum(q_s) * jnp.sum(q_f) / 5


def tied_system() -> tuple[System, State]:
    """Coupling constraints, one of them moved, and slow ones; and a consistent start."""
    system = System(FULL_MASS, tilted, constraint=Rheonomic(lifted), slow_constraint=sphere, params=np.asarray(3.0))
    return system, initial_state(system, [0.6, 0.8], [0.0, 1.0, 0.6], [0.4, -0.3], [0.2, 0.1, -0.1], project=True)


# --- a pendulum on a cart at a spring --------------------------------------------------------------------------------
def cart_spring(q_s, q_f, params):
    return params * jnp.sum(q_s**2) + 9.81 * q_f[1]


def rod(q_s, q_f, params):
    return (jnp.sum((q_f - jnp.append(q_s, 0.0)) ** 2, keepdims=True) - 0.25) / 2


def cart() -> Problem:
    """The cart is slow, the bob fast; the parameter is the stiffness of the spring."""
    system = System(ConstantMass([3.0], [1.0, 1.0]), cart_spring, constraint=rod, params=np.asarray(20.0))
    zero = np.zeros(1)
    return Problem(system, zero, np.array([0.0, -0.5]), zero, np.array([0.4, 0.0]))


# --- a pendulum: a point on a rod, at rest or on a pivot that swings, in still air
# -----------------------------------------

GRAVITY, MASS, LENGTH = 9.81, 2.0, 1.5


def hanging_weight(q_f, params):
    return MASS * GRAVITY * q_f[1]


def own_rod(q_s, q_f, params):
    return jnp.array([q_f @ q_f - LENGTH**2]) / 2


def swinging_rod(t, q_s, q_f, params):
    pivot = jnp.stack([0.2 * jnp.sin(3 * t), jnp.zeros_like(t)])
    return jnp.array([jnp.sum((q_f - pivot) ** 2) - LENGTH**2]) / 2


def drag(t, q_s, q_f, v_s, v_f, params):
    return jnp.zeros(0), -0.3 * v_f

"""The systems of the study in minimal coordinates: bonds of one length as two angles each, so that no constraint is left.

With the positions x(q) of all points the systems keep their energies,

    T(q, v) = T(x'(q) v),   V(q) = V(x(q)),   W(q_f) = W(x_f(q_f))

W measures distances among fast points alone; what these hang on may lie anywhere.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import vmri_jax as vm
from vmri_jax import systems


def direction(angles, axis: int):
    """The unit vector ``(sin e, cos e cos a, cos e sin a)`` of two angles (a, e), its poles on an axis (0, 1, 2)."""
    a, e = angles
    return jnp.roll(jnp.stack([jnp.sin(e), jnp.cos(e) * jnp.cos(a), jnp.cos(e) * jnp.sin(a)]), axis)


def angles_of(vector, axis: int) -> np.ndarray:
    """The inverse of `direction`, of a vector of any length."""
    along, first, second = np.roll(np.asarray(vector) / np.linalg.norm(vector), -axis)
    return np.array([np.arctan2(second, first), np.arcsin(along)])


def minimal(problem: vm.Problem, positions: Callable, q_s: np.ndarray, q_f: np.ndarray) -> vm.Problem:
    """The problem in coordinates in which it has no constraints.

    Args:
        problem: with constant masses, its start consistent after projection.
        positions: ``positions(q_s, q_f, params)`` to (x_s, x_f).
        q_s, q_f: coordinates of its start.
    """
    system, state = problem.system, problem.state()
    masses = np.concatenate([np.asarray(system.kinetic.slow), np.asarray(system.kinetic.fast)])  # pyright: ignore

    def joined(q, params):
        return jnp.concatenate(positions(q[: q_s.size], q[q_s.size :], params))

    def kinetic(q_s, q_f, v_s, v_f, params):
        q, v = jnp.concatenate([q_s, q_f]), jnp.concatenate([v_s, v_f])
        return jnp.sum(masses * jax.jvp(lambda q: joined(q, params), (q,), (v,))[1] ** 2) / 2

    def slow_potential(q_s, q_f, params):
        return system.slow_potential(*positions(q_s, q_f, params), params)  # pyright: ignore[reportOptionalCall]

    def fast_potential(q_f, params):
        return system.fast_potential(positions(jnp.zeros(q_s.size), q_f, params)[1], params)  # pyright: ignore

    q, v = np.concatenate([q_s, q_f]), np.concatenate([state.p_s, state.p_f]) / masses
    jacobian = jax.jacfwd(lambda q: joined(q, system.params))(jnp.asarray(q))
    rates = np.linalg.lstsq(np.asarray(jacobian), v)[0]  # exact, since the velocities keep the bonds
    made = vm.System(kinetic, slow_potential, fast_potential, params=system.params)
    return vm.Problem(made, q_s, q_f, rates[: q_s.size], rates[q_s.size :])


def pendulum_positions(q_s, q_f, params):
    """q_1 by two angles, q_2 by two angles about q_1, q_3 by its way from q_2."""
    l_1, l_2, _ = params["lengths"]
    first = l_1 * direction(q_s, 1)
    second = first + l_2 * direction(q_f[:2], 0)
    return first, jnp.concatenate([second, second + q_f[2:]])


def triple_spherical_pendulum() -> vm.Problem:
    """Two slow coordinates and five fast ones instead of 3 + 1 and 6 + 1."""
    problem = systems.triple_spherical_pendulum()
    first, (second, third) = np.asarray(problem.q_s), np.asarray(problem.q_f).reshape(2, 3)
    q_f = np.concatenate([angles_of(second - first, 0), third - second])
    return minimal(problem, pendulum_positions, angles_of(first, 1), q_f)


def atom_positions(q_s, q_f, params):
    """q_1 by two angles, q_2; q_3 by its way from q_2, q_4 and q_5 by angles about q_2, q_6 by angles about q_3."""
    length = params["length"]
    second, third = q_s[2:], q_s[2:] + q_f[:3]
    fourth, fifth = (second + length * direction(q_f[k : k + 2], 0) for k in (3, 5))
    sixth = third + length * direction(q_f[7:], 0)
    return jnp.concatenate([length * direction(q_s[:2], 0), second]), jnp.concatenate([third, fourth, fifth, sixth])


def simple_atomic_model() -> vm.Problem:
    """Five slow coordinates and nine fast ones instead of 6 + 1 and 12 + 3."""
    problem = systems.simple_atomic_model()
    state = problem.state()
    first, second = np.asarray(state.q_s).reshape(2, 3)
    third, fourth, fifth, sixth = np.asarray(state.q_f).reshape(4, 3)
    angles = [angles_of(bond, 0) for bond in (fourth - second, fifth - second, sixth - third)]
    q_s = np.concatenate([angles_of(first, 0), second])
    return minimal(problem, atom_positions, q_s, np.concatenate([third - second, *angles]))

"""Linearisation at a state: frequencies, derivative of a step, condition numbers of its equations."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from vmri_jax.mechanics.arrays import quickly_compiled
from vmri_jax.mechanics.invariants import all_constraints, potential_energy, velocity
from vmri_jax.mechanics.state import Movable, State, start_of
from vmri_jax.mechanics.system import System
from vmri_jax.running.macro_step import macro_step
from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.equations import StepEquations
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.results import Result
from vmri_jax.steppers.solver import Solver


def phase_vector(state: State):
    """``z = (q_s, q_f, p_s, p_f)``, joined, (2 n,), or (k, 2 n) for k states."""
    return jnp.concatenate([state.q_s, state.q_f, state.p_s, state.p_f], axis=-1)


def phase_splits(state: State) -> tuple[int, int, int]:
    """The indices at which ``jnp.split`` cuts a `phase_vector` into q_s, q_f, p_s, p_f."""
    n_s, n = state.q_s.size, state.q_s.size + state.q_f.size
    return n_s, n, n + n_s


def change_of_form(M, at_start, at_end):
    """``M^T J M - J`` with ``J = [[0, 1], [-1, 0]]``, for a derivative M (k, k) between tangent spaces with the bases (k, 2 n)."""
    J = np.kron([[0.0, 1.0], [-1.0, 0.0]], np.eye(at_start.shape[1] // 2))
    return M.T @ (at_end @ J @ at_end.T) @ M - at_start @ J @ at_start.T


def tangents(system: System, t, z, splits):
    """Orthonormal basis, one row each, of the tangent vectors of the constraint manifold.

    Args:
        system: the system with the constraints.
        t: time.
        z: (2 n,) point ``(q_s, q_f, p_s, p_f)`` on the manifold.
        splits: of `phase_splits`.
    """

    def constraints(z):
        return jnp.concatenate(all_constraints(system, State(t, *jnp.split(z, splits))))

    return _null_space(jax.jacfwd(constraints)(z))


def _null_space(normals):
    """Orthonormal basis, one vector per row, of the space orthogonal to the rows of `normals`, which are linearly independent."""
    if not normals.shape[0]:
        return jnp.eye(normals.shape[1])
    return jnp.linalg.svd(normals, full_matrices=True)[2][normals.shape[0] :]


def frequencies(system: Movable, state: State | None = None):
    """Angular frequencies of small vibrations about a state, the largest first.

    ``Hessian(V + W + sum_i V_i) u = omega^2 M u`` for shapes u tangent to the constraints; zero where omega^2 is not positive. Away from an equilibrium
    the frequencies are estimates, since the constraint forces are left out.

    Args:
        system: a problem, a scene, or a system.
        state: point of linearisation; None for the start of the problem.
    """
    system, state = start_of("frequencies", system, state)
    n_s = state.q_s.size
    q = jnp.concatenate([state.q_s, state.q_f])
    v = jnp.concatenate(velocity(system, state.q_s, state.q_f, state.p_s, state.p_f))

    def potential(q):
        return potential_energy(system, q[:n_s], q[n_s:])

    mass = jax.hessian(lambda v: system.kinetic_energy(q[:n_s], q[n_s:], v[:n_s], v[n_s:]))(v)
    basis = np.asarray(_null_space(jax.jacfwd(lambda q: system.constraints(state.t, q[:n_s], q[n_s:]))(q)))
    # With M = L L^T, the squares omega^2 are the eigenvalues of the symmetric matrix L^-1 K L^-T.
    cholesky = np.linalg.cholesky(basis @ np.asarray(mass) @ basis.T)
    stiffness = basis @ np.asarray(jax.hessian(potential)(q)) @ basis.T
    return frequencies_of(np.linalg.solve(cholesky, np.linalg.solve(cholesky, stiffness).T))


def frequencies_of(stiffness: np.ndarray) -> np.ndarray:
    """``omega_i = sqrt(max(lambda_i, 0))`` of the symmetric part of a (d, d) stiffness for unit masses, largest first."""
    return np.sqrt(np.maximum(np.linalg.eigvalsh((stiffness + stiffness.T) / 2)[::-1], 0.0))


def symplectic_defect(
    system: Movable, scheme: Scheme | Composition, state: State | None = None, *, macro_dt, solver: Solver | None = None
):
    """Largest entry of ``M^T J M - J`` for the derivative M of one macro step, on the constraint manifold.

    With constraints, the form is compared on tangent vectors of the constraint manifold only, in an orthonormal basis.

    Args:
        system, scheme, macro_dt, solver: as in `simulate`.
        state: fulfils the constraints; None for the start of the problem.
    """
    system, state = start_of("symplectic_defect", system, state)
    _, M, at_start, at_end, _, _ = derivative_along(system, scheme, state, macro_dt, solver, 1)
    return jnp.max(jnp.abs(change_of_form(M, at_start, at_end)))


@quickly_compiled
def derivative_along(system: System, scheme: Scheme | Composition, state: State, macro_dt, solver, num_steps):
    """Derivative of num_steps macro steps, ``M = DPhi(z_(N-1)) ... DPhi(z_0)``, between tangent spaces of the constraint manifold.

    Returns:
        The end z_N (2 n,), M (k, k), orthonormal bases (k, 2 n) of the tangent spaces at the start and at the end, the number of steps that
        were taken, and the status of the last one: a step that fails is the last.
    """
    splits = phase_splits(state)

    def step(z, t):
        end, info = macro_step(system, scheme, State(t, *jnp.split(z, splits)), macro_dt, solver)
        z = phase_vector(end)
        return z, (z, info.result)

    def advance(carry):
        z, matrix, basis, k, _ = carry
        t = state.t + k * macro_dt
        derivative, (z, result) = jax.jacfwd(lambda z: step(z, t), has_aux=True)(z)
        end_basis = tangents(system, t + macro_dt, z, splits)
        return z, end_basis @ derivative @ (basis.T @ matrix), end_basis, k + 1, jnp.asarray(result, int)

    def goes_on(carry):
        *_, k, result = carry
        return (k < num_steps) & (result <= Result.CONVERGED_AT_ROUNDOFF)

    z = phase_vector(state)
    basis = tangents(system, state.t, z, splits)
    start = z, jnp.eye(len(basis)), basis, jnp.zeros((), int), jnp.zeros((), int)
    z, matrix, end_basis, k, result = jax.lax.while_loop(goes_on, advance, start)
    return z, matrix, basis, end_basis, k, result


def step_condition(system: Movable, scheme: Scheme, state: State | None = None, *, macro_dt, sweeps: int = 10) -> float:
    """Condition number of the Newton matrix of a macro step, rows and columns scaled to length one.

    The Newton matrix of the first iteration, which starts from straight motion, is formed as a dense matrix: take few micro steps. Each
    sweep divides rows and columns by the square roots of their lengths (Ruiz 2001).

    Args:
        system, scheme, state, macro_dt: as in `simulate`.
        sweeps: number of sweeps.
    """
    system, state = start_of("step_condition", system, state)
    a = np.asarray(newton_matrix(system, scheme, state, macro_dt))
    for _ in range(sweeps):
        rows, columns = np.linalg.norm(a, axis=1), np.linalg.norm(a, axis=0)
        if not (np.isfinite(a).all() and rows.all() and columns.all()):
            return np.inf
        a = a / np.sqrt(rows[:, None] * columns)
    return float(np.linalg.cond(a))


@jax.jit
def newton_matrix(system: System, scheme: Scheme, state: State, macro_dt):
    """The dense Newton matrix of a macro step in the first iteration, which starts from straight motion."""
    equations = StepEquations(system, scheme, state.t, state.q_s, state.q_f, state.p_s, state.p_f, macro_dt)
    v_s, v_f = velocity(system, state.q_s, state.q_f, state.p_s, state.p_f)
    n_g, n_gs = system.num_constraints(state.q_s, state.q_f)
    x, unravel = ravel_pytree(equations.guess(v_s, v_f, jnp.zeros(n_g), jnp.zeros(n_gs)))
    return jax.jacfwd(lambda x: ravel_pytree(equations.residual(unravel(x)))[0])(x)

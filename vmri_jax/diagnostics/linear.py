"""Linearised at a state: frequencies, the derivative of a step, the condition of its equations."""

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.invariants import all_constraints, potential_energy, velocity
from vmri_jax.mechanics.state import Movable, State, start_of
from vmri_jax.mechanics.system import System
from vmri_jax.running.macro_step import macro_step
from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.equations import StepEquations
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.newton import dense
from vmri_jax.steppers.solvers import Newton


def phase_vector(state: State):
    """``z = (q_s, q_f, p_s, p_f)``, joined, (2 n,)."""
    return jnp.concatenate([state.q_s, state.q_f, state.p_s, state.p_f])


def phase_splits(state: State) -> tuple[int, int, int]:
    """Where ``jnp.split`` cuts a `phase_vector` into its four parts."""
    n_s, n = state.q_s.size, state.q_s.size + state.q_f.size
    return n_s, n, n + n_s


def symplectic_form(n: int) -> np.ndarray:
    """``J = [[0, 1], [-1, 0]]``, (2 n, 2 n)."""
    return np.kron([[0.0, 1.0], [-1.0, 0.0]], np.eye(n))


def tangents(system: System, t, z, splits):
    """Orthonormal basis, one row each, of the tangent vectors of the constraint manifold.

    Args:
        system: its constraints.
        t: time.
        z: (2 n,) point ``(q_s, q_f, p_s, p_f)`` on the manifold.
        splits: where z is cut into its four parts.
    """

    def constraints(z):
        return jnp.concatenate(all_constraints(system, State(t, *jnp.split(z, splits))))

    return _null_space(jax.jacfwd(constraints)(z))


def _null_space(normals):
    """Orthonormal basis, one row each, of the vectors that are orthogonal to independent rows."""
    if not normals.shape[0]:
        return jnp.eye(normals.shape[1])
    return jnp.linalg.svd(normals, full_matrices=True)[2][normals.shape[0] :]


def frequencies(system: Movable, state: State | None = None):
    """Angular frequencies of small vibrations about a state, the largest first: those of the frozen linear problem.

    Square roots of the generalised eigenvalues of ``Hessian(V + W)`` and the mass matrix on the tangent space of the
    constraints; zero where the curvature is not positive. Away from equilibrium they are estimates: forces of the
    constraints are left out.

    Args:
        system: masses, potentials, constraints; a problem, a scene, or a system.
        state: where it is linearised; None for the start of the problem.
    """
    system, state = start_of("frequencies", system, state)
    n_s = state.q_s.size
    q = jnp.concatenate([state.q_s, state.q_f])
    v = jnp.concatenate(velocity(system, state.q_s, state.q_f, state.p_s, state.p_f))

    def potential(q):
        return potential_energy(system, q[:n_s], q[n_s:])

    mass = jax.hessian(lambda v: system.kinetic(q[:n_s], q[n_s:], v[:n_s], v[n_s:], system.params))(v)
    basis = np.asarray(_null_space(jax.jacfwd(lambda q: system.constraints(state.t, q[:n_s], q[n_s:]))(q)))
    half = np.linalg.cholesky(basis @ np.asarray(mass) @ basis.T)
    stiffness = basis @ np.asarray(jax.hessian(potential)(q)) @ basis.T
    inner = np.linalg.solve(half, np.linalg.solve(half, stiffness).T)
    return frequencies_of(inner)


def frequencies_of(stiffness: np.ndarray) -> np.ndarray:
    """``omega_i = sqrt(max(lambda_i, 0))`` of the symmetric part of a (d, d) stiffness for unit masses, largest first."""
    return np.sqrt(np.maximum(np.linalg.eigvalsh((stiffness + stiffness.T) / 2)[::-1], 0.0))


def symplectic_defect(
    system: Movable,
    scheme: Scheme | Composition,
    state: State | None = None,
    *,
    macro_dt,
    solver: Newton | None = None,
):
    """Largest entry of ``M^T J M - J`` for the derivative M of one macro step, on the constraint manifold.

    With constraints, the form is compared on tangent vectors of the constraint manifold only, in an orthonormal basis.

    Args:
        system, scheme, macro_dt, solver: as in `simulate`.
        state: fulfils the constraints; None for the start of the problem.
    """
    system, state = start_of("symplectic_defect", system, state)
    z, splits = phase_vector(state), phase_splits(state)

    def step(z):
        start = State(state.t, *jnp.split(z, splits))
        return phase_vector(macro_step(system, scheme, start, macro_dt, solver)[0])

    M = jax.jit(jax.jacfwd(step))(z)
    J = symplectic_form(z.size // 2)
    basis = tangents(system, state.t, z, splits)
    return jnp.max(jnp.abs(basis @ (M.T @ J @ M - J) @ basis.T))


def step_condition(system: Movable, scheme: Scheme, state: State | None = None, *, macro_dt, sweeps: int = 10) -> float:
    """Condition number of the Newton matrix of a macro step, rows and columns scaled to length one.

    The matrix is that of the first iteration from straight motion; it is dense here, so take few micro steps. Scaling is
    by square roots of the lengths, again and again (Ruiz 2001).

    Args:
        system, scheme, state, macro_dt: as in `simulate`.
        sweeps: times that rows and columns are scaled.
    """
    system, state = start_of("step_condition", system, state)
    a = np.asarray(_newton_matrix(system, scheme, state, macro_dt))
    for _ in range(sweeps):
        rows, columns = np.linalg.norm(a, axis=1), np.linalg.norm(a, axis=0)
        if not (np.isfinite(a).all() and rows.all() and columns.all()):
            return np.inf
        a = a / np.sqrt(rows[:, None] * columns)
    return float(np.linalg.cond(a))


def null_space_condition(system: Movable, scheme: Scheme, state: State | None = None, *, macro_dt) -> float:
    """Condition number of the Newton matrix of a macro step on its free motions, without any scaling.

    The equations of motion, their multipliers removed by a basis P of the null space of the constraints, ``P^T A P``: what the
    method "null_space" of `Newton` solves. The matrix is that of the first iteration from straight motion; it is dense here.

    Args:
        system, scheme, state, macro_dt: as in `simulate`.
    """
    from scipy.linalg import null_space  # here: its import takes a tenth of a second

    system, state = start_of("null_space_condition", system, state)
    whole = np.asarray(_newton_matrix(system, scheme, state, macro_dt))
    n, r = scheme.num_micro, scheme.degree
    n_g, n_gs = system.num_constraints(state.q_s, state.q_f)
    sizes = r * state.q_s.size, r * n_gs, n * r * state.q_f.size, n * r * n_g
    held = np.repeat([False, True, False, True], sizes)  # the order of `Unknowns`
    left, right = null_space(whole[np.ix_(~held, held)].T), null_space(whole[np.ix_(held, ~held)])
    reduced = left.T @ whole[np.ix_(~held, ~held)] @ right
    return float(np.linalg.cond(reduced)) if np.isfinite(reduced).all() else np.inf


@jax.jit
def _newton_matrix(system, scheme, state, macro_dt):
    equations = StepEquations(system, scheme, state.t, state.q_s, state.q_f, state.p_s, state.p_f, macro_dt)
    v_s, v_f = velocity(system, state.q_s, state.q_f, state.p_s, state.p_f)
    n_g, n_gs = system.num_constraints(state.q_s, state.q_f)
    x = equations.guess(v_s, v_f, jnp.zeros(n_g), jnp.zeros(n_gs))
    return dense.matrix(equations, x)

"""Linearised at a state: frequencies, the derivative of a step, the condition of its equations."""

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.invariants import all_constraints, potentials, velocity
from vmri_jax.mechanics.state import State
from vmri_jax.mechanics.system import System
from vmri_jax.running.macro_step import macro_step
from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.equations import StepEquations
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.newton import Newton, dense


def tangents(system: System, t, z, splits):
    """Orthonormal basis, one row each, of the tangent vectors of the constraint manifold at ``z = (q_s, q_f, p_s, p_f)``."""
    return _across(jax.jacfwd(lambda z: jnp.concatenate(all_constraints(system, State(t, *jnp.split(z, splits)))))(z))


def _across(normals):
    """Orthonormal basis, one row each, of the vectors that are orthogonal to independent rows."""
    if not normals.shape[0]:
        return jnp.eye(normals.shape[1])
    return jnp.linalg.svd(normals, full_matrices=True)[2][normals.shape[0] :]


def frequencies(system: System, state: State):
    """Angular frequencies of small vibrations about a state, the largest first: those of the frozen linear problem.

    Square roots of the generalised eigenvalues of ``Hessian(V + W)`` and the mass matrix on the tangent space of the
    constraints; zero where the curvature is not positive. Away from equilibrium they are estimates: forces of the
    constraints are left out.

    Args:
        system: masses, potentials, constraints.
        state: where it is linearised.
    """
    n_s = state.q_s.size
    q = jnp.concatenate([state.q_s, state.q_f])
    v = jnp.concatenate(velocity(system, state.q_s, state.q_f, state.p_s, state.p_f))

    def potential(q):
        return sum(potentials(system, q[:n_s], q[n_s:]))

    mass = jax.hessian(lambda v: system.kinetic(q[:n_s], q[n_s:], v[:n_s], v[n_s:], system.params))(v)
    basis = np.asarray(_across(jax.jacfwd(lambda q: system.constraints(state.t, q[:n_s], q[n_s:]))(q)))
    half = np.linalg.cholesky(basis @ np.asarray(mass) @ basis.T)
    stiffness = basis @ np.asarray(jax.hessian(potential)(q)) @ basis.T
    inner = np.linalg.solve(half, np.linalg.solve(half, stiffness).T)
    return np.sqrt(np.maximum(np.linalg.eigvalsh((inner + inner.T) / 2)[::-1], 0.0))


def symplectic_defect(
    system: System, scheme: Scheme | Composition, state: State, macro_dt, newton: Newton | None = None
):
    """Largest entry of ``M^T J M - J`` for the derivative M of one macro step, on the constraint manifold.

    With constraints, the form is compared on tangent vectors of the constraint manifold only, in an orthonormal basis.

    Args:
        system, scheme, state, macro_dt, newton: as in `macro_step`; the state fulfils the constraints.
    """
    n_s, n_f = state.q_s.size, state.q_f.size
    n = n_s + n_f
    splits = (n_s, n, n + n_s)

    def step(z):
        s, _ = macro_step(system, scheme, State(state.t, *jnp.split(z, splits)), macro_dt, newton)
        return jnp.concatenate([s.q_s, s.q_f, s.p_s, s.p_f])

    z = jnp.concatenate([state.q_s, state.q_f, state.p_s, state.p_f])
    M = jax.jit(jax.jacfwd(step))(z)
    J = jnp.block([[jnp.zeros((n, n)), jnp.eye(n)], [-jnp.eye(n), jnp.zeros((n, n))]])
    basis = tangents(system, state.t, z, splits)
    return jnp.max(jnp.abs(basis @ (M.T @ J @ M - J) @ basis.T))


def step_condition(system: System, scheme: Scheme, state: State, macro_dt, sweeps: int = 10) -> float:
    """Condition number of the Newton matrix of a macro step, rows and columns scaled to length one.

    The matrix is that of the first iteration from straight motion; it is dense here, so take few micro steps. Scaling is
    by square roots of the lengths, again and again (Ruiz 2001).

    Args:
        system, scheme, state, macro_dt: as in `macro_step`.
        sweeps: times that rows and columns are scaled.
    """
    a = np.asarray(_newton_matrix(system, scheme, state, macro_dt))
    for _ in range(sweeps):
        rows, columns = np.linalg.norm(a, axis=1), np.linalg.norm(a, axis=0)
        if not (np.isfinite(a).all() and rows.all() and columns.all()):
            return np.inf
        a = a / np.sqrt(rows[:, None] * columns)
    return float(np.linalg.cond(a))


@jax.jit
def _newton_matrix(system, scheme, state, macro_dt):
    equations = StepEquations(system, scheme, state.t, state.q_s, state.q_f, state.p_s, state.p_f, macro_dt)
    v_s, v_f = velocity(system, state.q_s, state.q_f, state.p_s, state.p_f)
    n_g, n_gs = system.num_constraints(state.q_s, state.q_f)
    x = equations.guess(v_s, v_f, jnp.zeros(n_g), jnp.zeros(n_gs))
    return dense.matrix(equations, x)

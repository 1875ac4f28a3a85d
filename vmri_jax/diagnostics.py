"""What a discrete trajectory should keep, and how to see whether it does."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.kernels import max_abs
from vmri_jax.mechanics.state import State, project_momentum
from vmri_jax.mechanics.system import System
from vmri_jax.running.macro_step import macro_step
from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.equations import StepEquations
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.newton import Newton, dense


def energy_parts(system: System, q_s, q_f, p_s, p_f) -> dict:
    """Parts of the Hamiltonian ``p . v - T(q, v) + V + W``: "kinetic", "slow" and "fast"."""
    v_s, v_f = velocity(system, q_s, q_f, p_s, p_f)
    kinetic = jnp.sum(p_s * v_s) + jnp.sum(p_f * v_f) - system.kinetic(q_s, q_f, v_s, v_f, system.params)
    zero = jnp.zeros(())
    slow = zero if system.slow_potential is None else system.slow_potential(q_s, q_f, system.params)
    fast = zero if system.fast_potential is None else system.fast_potential(q_f, system.params)
    return {"kinetic": kinetic, "slow": slow, "fast": fast}


def energy(system: System, q_s, q_f, p_s, p_f):
    """Hamiltonian ``p . v - T(q, v) + V(q_s, q_f) + W(q_f)`` with v the velocity of p."""
    parts = energy_parts(system, q_s, q_f, p_s, p_f)
    return parts["kinetic"] + parts["slow"] + parts["fast"]


def oscillatory_energies(omega, q_f, p_f):
    """Energies ``I_i = (p_fi^2 + omega^2 q_fi^2) / 2`` of unit-mass harmonic oscillators, e.g. the stiff FPU springs."""
    return (p_f**2 + omega**2 * q_f**2) / 2


def constraint_residual(system: System, state: State):
    """Largest ``|g|`` (position level) and largest ``|G v + dg/dt|`` (velocity level), shape (2,)."""
    return jax.vmap(max_abs)(jnp.stack(all_constraints(system, state)))


def all_constraints(system: System, state: State):
    """Constraints and hidden constraints, ``(g, G v + dg/dt)``, each (n_g + n_gs,): zero on the constraint manifold."""
    at = state.t, state.q_s, state.q_f
    v = velocity(system, state.q_s, state.q_f, state.p_s, state.p_f)
    return system.constraints(*at), system.constraint_rates(*at, *v)


def tangents(system: System, t, z, splits):
    """Orthonormal basis, one row each, of the tangent vectors of the constraint manifold at ``z = (q_s, q_f, p_s, p_f)``."""
    if not system.is_constrained:
        return jnp.eye(z.size)
    normals = jax.jacfwd(lambda z: jnp.concatenate(all_constraints(system, State(t, *jnp.split(z, splits)))))(z)
    return jnp.linalg.svd(normals, full_matrices=True)[2][normals.shape[0] :]


def velocity(system: System, q_s, q_f, p_s, p_f):
    """Velocities ``(v_s, v_f)`` of given momenta (inverse Legendre transform, constraints ignored)."""
    free = system.replace(constraint=None, slow_constraint=None)
    return project_momentum(free, State(jnp.zeros(()), q_s, q_f, p_s, p_f))[2:]


def momentum_map(generator, q_s, q_f, p_s, p_f):
    """Momentum map ``p . xi(q)`` of a symmetry with infinitesimal generator ``generator(q_s, q_f) -> (xi_s, xi_f)``."""
    xi_s, xi_f = generator(q_s, q_f)
    return p_s @ xi_s + p_f @ xi_f


def rotation_about(axis):
    """Generator of rotations of points in R^3 about an axis through the origin, ``xi(q) = axis x q``."""
    axis = jnp.asarray(axis, dtype=float)

    def generator(q_s, q_f):
        return tuple(jnp.cross(axis, q.reshape(-1, 3)).reshape(-1) for q in (q_s, q_f))

    return generator


def translation_along(direction):
    """Generator of translations of points in R^3, ``xi(q) = direction`` for every point."""
    direction = jnp.asarray(direction, dtype=float)

    def generator(q_s, q_f):
        return tuple(jnp.tile(direction, q.shape[0] // 3) for q in (q_s, q_f))

    return generator


def frequencies(system: System, state: State):
    """Angular frequencies of small vibrations about a state, the largest first: those of the frozen linear problem.

    Square roots of the generalised eigenvalues of ``Hessian(V + W)`` and the mass matrix on the tangent space of the
    constraints; zero where the curvature is not positive. Away from equilibrium they are estimates: forces of the
    constraints are left out.
    """
    n_s = state.q_s.size
    q = jnp.concatenate([state.q_s, state.q_f])
    v = jnp.concatenate(velocity(system, state.q_s, state.q_f, state.p_s, state.p_f))

    def potential(q):
        q_s, q_f, params = q[:n_s], q[n_s:], system.params
        slow = 0.0 if system.slow_potential is None else system.slow_potential(q_s, q_f, params)
        return slow + (0.0 if system.fast_potential is None else system.fast_potential(q_f, params))

    mass = jax.hessian(lambda v: system.kinetic(q[:n_s], q[n_s:], v[:n_s], v[n_s:], system.params))(v)
    normals = np.asarray(jax.jacfwd(lambda q: system.constraints(state.t, q[:n_s], q[n_s:]))(q))
    basis = np.linalg.svd(normals)[2][len(normals) :] if normals.size else np.eye(len(q))
    half = np.linalg.cholesky(basis @ np.asarray(mass) @ basis.T)
    stiffness = basis @ np.asarray(jax.hessian(potential)(q)) @ basis.T
    inner = np.linalg.solve(half, np.linalg.solve(half, stiffness).T)
    return np.sqrt(np.maximum(np.linalg.eigvalsh((inner + inner.T) / 2)[::-1], 0.0))


def symplectic_defect(
    system: System, scheme: Scheme | Composition, state: State, macro_dt, newton: Newton | None = None
):
    """Largest entry of ``M^T J M - J`` for the derivative M of one macro step, on the constraint manifold.

    With constraints, the form is compared on tangent vectors of the constraint manifold only, in an orthonormal basis.
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


class OrderFit(NamedTuple):
    """An observed order, half the width of its 95 % confidence interval (NaN for two points), and the points fitted."""

    order: float
    half_width: float
    points: int


STUDENT = (np.nan, 12.71, 4.30, 3.18, 2.78, 2.57, 2.45, 2.36, 2.31, 2.26, 2.23)
"""Quantiles 0.975 of Student's t distribution for 0, 1, ... degrees of freedom; about 2 beyond."""


def fit_order(macro_dt, errors, plateau: float = 10.0, floor: float = 0.0) -> OrderFit:
    """Order of convergence: least-squares slope of log error over log step, round-off plateau masked.

    The plateau is where errors stop falling with the step: from the first interval, towards smaller steps, whose slope
    is less than half the steepest one. Errors within a factor `plateau` of it, or of `floor`, are left out; at least the
    two largest steps stay.

    Args:
        macro_dt: (k,) step sizes.
        errors: (k,) errors; those that are not finite or zero are ignored.
        plateau: how far above the round-off plateau an error must lie to count.
        floor: known error of the reference.
    """
    h, e = np.asarray(macro_dt, dtype=float), np.asarray(errors, dtype=float)
    good = np.isfinite(e) & (e > 0)
    if good.sum() < 2:
        raise ValueError(f"fit_order: {good.sum()} usable errors of {np.size(errors)}; at least 2 are needed.")
    order = np.argsort(-h[good])
    h, e = h[good][order], e[good][order]
    slopes = np.diff(np.log(e)) / np.diff(np.log(h))
    flat = np.flatnonzero(slopes < slopes.max() / 2)
    flat = flat[flat > slopes.argmax()]
    level = max(floor, e[flat[0] + 1 :].max() if flat.size else 0.0)
    keep = e > plateau * level
    keep[:2] = True
    x, y = np.log(h[keep]), np.log(e[keep])
    slope, intercept = np.polyfit(x, y, 1)
    free = len(x) - 2
    half_width = np.nan
    if free:
        scatter = np.sum((y - slope * x - intercept) ** 2) / free / np.sum((x - x.mean()) ** 2)
        half_width = (STUDENT[free] if free < len(STUDENT) else 2.0) * np.sqrt(scatter)
    return OrderFit(float(slope), float(half_width), len(x))


def observed_order(macro_dt, errors, plateau: float = 10.0, floor: float = 0.0) -> float:
    """The order of `fit_order`."""
    return fit_order(macro_dt, errors, plateau, floor).order

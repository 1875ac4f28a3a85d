"""States: positions and momenta on the constraint manifold, and how a run gets its first one."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.checks import check_arrays, check_system, require_x64
from vmri_jax.quadrature import is_concrete
from vmri_jax.system import ConstantMass, System


class State(eqx.Module):
    """Time, slow and fast positions (n_s,), (n_f,) and their conjugate momenta."""

    t: Any
    q_s: Any
    q_f: Any
    p_s: Any
    p_f: Any


def legendre(system: System, q_s, q_f, v_s, v_f):
    """Continuous Legendre transform ``p = dT/dv``: (p_s, p_f)."""
    if isinstance(system.kinetic, ConstantMass):
        return system.kinetic.momentum(v_s, v_f)
    return jax.grad(system.kinetic, argnums=(2, 3))(q_s, q_f, v_s, v_f, system.params)


def project_momentum(system: System, q_s, q_f, p_s, p_f):
    """Momenta projected onto the hidden constraints, ``p <- p - G^T mu`` with ``G v = 0``, and their velocities.

    v is the velocity of the projected momentum, ``p - G^T mu = dT/dv``. For a kinetic energy at most quadratic in the
    velocities this is one linear solve; otherwise Newton's iteration, run until it no longer moves.

    Returns:
        (p_s, p_f, v_s, v_f)
    """
    n_s = q_s.shape[0]
    jacobian = jnp.concatenate(jax.jacrev(system.constraints, argnums=(0, 1))(q_s, q_f), axis=1)  # (n_g + n_gs, n)
    if isinstance(system.kinetic, ConstantMass):
        v_s, v_f = system.kinetic.velocity(p_s, p_f)
        if jacobian.shape[0]:
            inverse_mass = jnp.concatenate(system.kinetic.velocity(jacobian[:, :n_s], jacobian[:, n_s:]), axis=1)
            mu = jnp.linalg.solve(inverse_mass @ jacobian.T, jacobian @ jnp.concatenate([v_s, v_f]))
            correction = mu @ jacobian
            p_s, p_f = p_s - correction[:n_s], p_f - correction[n_s:]
            v_s, v_f = system.kinetic.velocity(p_s, p_f)
        return p_s, p_f, v_s, v_f

    def momentum(v):
        return jnp.concatenate(legendre(system, q_s, q_f, v[:n_s], v[n_s:]))

    p = jnp.concatenate([p_s, p_f])
    v = jnp.zeros_like(p)
    zero = jnp.zeros((jacobian.shape[0],) * 2)
    for _ in range(3):  # exact after one where T is quadratic in v
        matrix = jnp.block([[jax.jacfwd(momentum)(v), jacobian.T], [jacobian, zero]])
        step = jnp.linalg.solve(matrix, jnp.concatenate([p - momentum(v), -jacobian @ v]))
        v = v + step[: p.size]
    if jacobian.shape[0]:
        p = momentum(v)
    return p[:n_s], p[n_s:], v[:n_s], v[n_s:]


def project_positions(system: System, q_s, q_f, iterations: int = 20):
    """Positions moved onto the constraints along ``M^-1 G^T`` (the nearest point in the mass metric)."""
    n_s = q_s.shape[0]
    q0 = jnp.concatenate([q_s, q_f])

    def constraints(q):
        return system.constraints(q[:n_s], q[n_s:])

    def momentum(v):
        return jnp.concatenate(legendre(system, q_s, q_f, v[:n_s], v[n_s:]))

    mass = jax.jacfwd(momentum)(jnp.zeros_like(q0))
    directions = jnp.linalg.solve(mass, jax.jacrev(constraints)(q0).T)
    q = q0
    for _ in range(iterations):
        g = constraints(q)
        q = q - directions @ jnp.linalg.lstsq(jax.jacrev(constraints)(q) @ directions, g)[0]
    return q[:n_s], q[n_s:]


def initial_state(system: System, q_s, q_f, v_s, v_f, t=0.0, *, project: bool = False, tolerance=1e-9) -> State:
    """Consistent state from positions and velocities: ``p = dT/dv``, projected onto the hidden constraints.

    Args:
        q_s, q_f, v_s, v_f: (n_s,), (n_f,) arrays of float64.
        t: start time.
        project: move positions onto the constraints instead of refusing them.
        tolerance: largest constraint value, in the constraint's own unit, that counts as satisfied.

    Raises:
        ValueError: float32 data or 64-bit mode off, wrong shapes, not finite, positions that violate a constraint (with
            the size of the violation), constraints that the fast variables cannot satisfy.
    """
    require_x64()
    q_s, q_f, v_s, v_f = check_arrays(q_s=q_s, q_f=q_f, v_s=v_s, v_f=v_f)
    if project:
        q_s, q_f = _projected_positions(system, q_s, q_f)
    values, p_s, p_f = _momenta(system, q_s, q_f, v_s, v_f)
    if is_concrete((values, p_s, p_f)):
        _check_constraint_values(np.asarray(values), project, tolerance)
        check_constraints(system, q_s, q_f)
        if not all(np.isfinite(p).all() for p in (p_s, p_f)):
            raise ValueError(
                "initial_state: the momenta are not finite. The mass matrix d2T/dv2 or the constraint Jacobian is "
                "singular at the initial positions, or a function returned NaN there."
            )
    return State(jnp.asarray(t, dtype=float), q_s, q_f, p_s, p_f)


@jax.jit
def _momenta(system, q_s, q_f, v_s, v_f):
    """Constraint values and consistent momenta; what the user's functions return is checked while tracing."""
    check_system(system, q_s, q_f)
    momenta = project_momentum(system, q_s, q_f, *legendre(system, q_s, q_f, v_s, v_f))[:2]
    return system.constraints(q_s, q_f), *momenta


_projected_positions = jax.jit(project_positions)


@jax.jit
def _constraint_jacobians(system, q_s, q_f):
    return *jax.jacrev(system.g, argnums=(0, 1))(q_s, q_f), jax.jacrev(system.g_slow)(q_s)


def _check_constraint_values(values, projected: bool, tolerance: float) -> None:
    """Refuse positions off the constraints."""
    if not np.isfinite(values).all():
        raise ValueError(f"initial_state: the constraints are {values} at the initial positions, which is not finite.")
    worst = np.abs(values).max(initial=0.0)
    if worst > tolerance:
        advice = (
            "projection did not reach the constraints; start closer to them."
            if projected
            else "correct the positions, or pass project=True to move them onto the constraints."
        )
        raise ValueError(
            f"initial_state: the initial positions violate the constraints by {worst:.3e} (row {np.abs(values).argmax()} "
            f"of {values.size}, tolerance {tolerance:.0e}); {advice}"
        )


def check_constraints(system: System, q_s, q_f) -> None:
    """Refuse constraints that cannot be kept where they are held, with the reason and the fix."""
    if system.constraint is system.slow_constraint is None:
        return
    slow, fast, alone = (np.asarray(d) for d in _constraint_jacobians(system, q_s, q_f))
    (n_g, n_s), (_, n_f), n_gs = slow.shape, fast.shape, len(alone)
    if n_gs > n_s:
        raise ValueError(
            f"System: slow_constraint returns {n_gs} values for {n_s} slow variables; at most {n_s} can be satisfied."
        )
    if not n_g:
        return
    fix = (
        "A constraint held on the micro grid must be satisfiable by the fast variables: the slow ones have one value "
        "per macro step, so that a slow-only constraint held at every micro node is over-determined (rank deficit "
        "num_micro - 1)."
    )
    if n_g > n_f:
        raise ValueError(f"System: constraint returns {n_g} values for {n_f} fast variables. {fix} Remove rows.")
    if not (np.isfinite(slow).all() and np.isfinite(fast).all()):
        raise ValueError("System: the Jacobian of constraint is not finite at these positions (a norm at zero?).")
    size = np.linalg.norm(np.concatenate([slow, fast], axis=1), axis=1)
    slow_only = np.flatnonzero(np.linalg.norm(fast, axis=1) <= 1e-12 * size)
    if slow_only.size:
        raise ValueError(
            f"System: row(s) {slow_only.tolist()} of constraint do not depend on the fast variables q_f. {fix} "
            "Pass them as slow_constraint(q_s, params), which is held at the macro nodes."
        )
    rank = np.linalg.matrix_rank(fast / np.linalg.norm(fast, axis=1, keepdims=True), tol=1e-8)
    if rank < n_g:
        raise ValueError(
            f"System: the {n_g} constraint rows have rank {rank} in the fast variables at the initial positions. {fix} "
            "Remove redundant rows, or make the variables they need fast."
        )

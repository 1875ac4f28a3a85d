"""States: positions and momenta on the constraint manifold, and how a run gets its first one."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax import kernels
from vmri_jax.mechanics.arrays import is_concrete
from vmri_jax.mechanics.checks import (
    CONSTRAINT_TOLERANCE,
    check_arrays,
    check_flags,
    check_number,
    check_params,
    check_system,
    check_type,
    require_x64,
)
from vmri_jax.mechanics.system import ConstantMass, System


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


def project_momentum(system: System, state: State, guess=None):
    """Momenta projected onto the hidden constraints, ``p <- p - G^T mu`` with ``G v + dg/dt = 0``, and their velocities.

    v is the velocity of the projected momentum, ``p - G^T mu = dT/dv``: of all v with ``G v + dg/dt = 0`` the one that
    minimises ``T(v) - p . v``.
    For constant masses that is one linear solve, else Newton's iteration with a line search from `guess` (v_s, v_f), or
    from rest; the kinetic energy must be convex in the velocities.

    Returns:
        (p_s, p_f, v_s, v_f)
    """
    t, q_s, q_f, p_s, p_f = state.t, state.q_s, state.q_f, state.p_s, state.p_f
    n_s = q_s.shape[0]
    constraints = partial(system.constraints, t)
    if isinstance(system.kinetic, ConstantMass):
        velocity = system.kinetic.velocity
        g, pull = jax.vjp(constraints, q_s, q_f)
        if g.size:
            push = jax.linearize(constraints, q_s, q_f)[1]
            matrix = jax.vmap(lambda unit: push(*velocity(*pull(unit))))(jnp.eye(g.size))  # G M^-1 G^T
            rates = push(*velocity(p_s, p_f))
            if system.is_rheonomic:
                rates = rates + _own_rates(system, t, q_s, q_f)
            mu = kernels.solve(kernels.regularized(matrix), rates[:, None])[:, 0]
            pull_s, pull_f = pull(mu)
            p_s, p_f = p_s - pull_s, p_f - pull_f
        return p_s, p_f, *velocity(p_s, p_f)

    jacobian = jnp.concatenate(jax.jacrev(constraints, argnums=(0, 1))(q_s, q_f), axis=1)  # (n_g + n_gs, n)
    own = _own_rates(system, t, q_s, q_f)
    p = jnp.concatenate([p_s, p_f])
    v = _velocity(system, q_s, q_f, jacobian, own, p, jnp.zeros_like(p) if guess is None else jnp.concatenate(guess))
    v_s, v_f = v[:n_s], v[n_s:]
    if jacobian.shape[0]:
        p_s, p_f = legendre(system, q_s, q_f, v_s, v_f)
    return p_s, p_f, v_s, v_f


def _own_rates(system: System, t, q_s, q_f):
    """``dg/dt`` of all constraints (n_g + n_gs,) at fixed positions."""
    if not system.is_rheonomic:
        return jnp.zeros(sum(system.num_constraints(q_s, q_f)))
    return system.constraint_rates(t, q_s, q_f, jnp.zeros_like(q_s), jnp.zeros_like(q_f))


def _velocity(system: System, q_s, q_f, jacobian, own, p, guess, max_iterations: int = 50):
    """The v that minimises ``T(v) - p . v`` over ``jacobian v + own = 0``; NaN where Newton's iteration does not converge."""

    def kinetic(system, q_s, q_f, v):
        return system.kinetic(q_s, q_f, v[: q_s.size], v[q_s.size :], system.params)

    def direction(at, v):
        system, q_s, q_f, jacobian, own, p = at
        hessian, gradient = (d(lambda v: kinetic(system, q_s, q_f, v))(v) for d in (jax.hessian, jax.grad))
        matrix = kernels.saddle(hessian, jacobian.T, jacobian)
        return jnp.linalg.solve(matrix, jnp.concatenate([p - gradient, -(jacobian @ v + own)]))[: v.size]

    def search(carry):
        v, k, _ = carry
        system, q_s, q_f, jacobian, own, p = fixed
        d = direction(fixed, v)
        small = kernels.max_abs(d) <= 1e-9 * kernels.max_abs(v)  # the two steps at the end do the rest
        merit = jax.vmap(lambda v: kinetic(system, q_s, q_f, v) - p @ v)(v + fractions[:, None] * d)
        on_constraints = kernels.max_abs(jacobian @ v + own) <= 1e-9 * kernels.max_abs(v)
        better = jnp.isfinite(merit) & ((merit < merit[-1]) | ~on_constraints)
        stop = small | ~jnp.any(better)
        return jnp.where(stop, v, v + fractions[jnp.argmax(better)] * d), k + 1, stop

    at = (system, q_s, q_f, jacobian, own, p)
    fixed, guess = jax.lax.stop_gradient((at, guess))
    fractions = jnp.append(0.5 ** jnp.arange(12.0), 0.0)
    start = (guess, 0, jnp.asarray(False))
    v = jax.lax.while_loop(lambda carry: ~carry[2] & (carry[1] < max_iterations), search, start)[0]
    for _ in range(2):  # Newton's map is flat at its fixed point: these two carry first and second derivatives
        d = direction(at, v)
        v = v + d
    return jnp.where(kernels.max_abs(d) <= 1e-6 * kernels.max_abs(v) + 1e-300, v, jnp.nan)


def project_positions(system: System, t, q_s, q_f, iterations: int = 20):
    """Positions moved onto the constraints at a time, along ``M^-1 G^T`` (the nearest point in the mass metric)."""
    n_s = q_s.shape[0]
    q0 = jnp.concatenate([q_s, q_f])

    def constraints(q):
        return system.constraints(t, q[:n_s], q[n_s:])

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
    check_type("initial_state: system", system, System, "a vmri_jax.System")
    check_params(system.params)
    check_flags(project=project)
    t = check_number("t", t)
    check_number("tolerance", tolerance)
    q_s, q_f, v_s, v_f = check_arrays(q_s=q_s, q_f=q_f, v_s=v_s, v_f=v_f)
    if project:
        q_s, q_f = _projected_positions(system, t, q_s, q_f)
    state = State(t, q_s, q_f, *_momenta(system, t, q_s, q_f, v_s, v_f))
    if is_concrete(state):
        advice = (
            "projection did not reach the constraints; start closer to them."
            if project
            else "correct the positions, or pass project=True to move them onto the constraints."
        )
        check_constraints(system, state, "initial_state: the initial positions", tolerance, advice)
        if not all(np.isfinite(p).all() for p in (state.p_s, state.p_f)):
            raise ValueError(
                "initial_state: the momenta are not finite. The mass matrix d2T/dv2 or the constraint Jacobian is "
                "singular at the initial positions, or a function returned NaN there."
            )
    return state


@dataclass(frozen=True)
class Problem:
    """A system with initial positions and velocities, (n_s,), (n_f,), which are kept as arrays.

    drawing: what it looks like, plain data for `vmri_jax.animation.Drawing`; None if that is not known.

    Raises:
        TypeError, ValueError: arrays as `initial_state` refuses them.
    """

    system: System
    q_s: Any
    q_f: Any
    v_s: Any
    v_f: Any
    t: Any = 0.0
    drawing: Any = None

    def __post_init__(self):
        require_x64()
        check_type("Problem: system", self.system, System, "a vmri_jax.System")
        names = "q_s", "q_f", "v_s", "v_f"
        for name, array in zip(names, check_arrays(**{name: getattr(self, name) for name in names}), strict=True):
            object.__setattr__(self, name, array)

    def state(self, project: bool = False) -> State:
        """The consistent initial `State` (see `initial_state`)."""
        return initial_state(self.system, self.q_s, self.q_f, self.v_s, self.v_f, self.t, project=project)


@jax.jit
def _momenta(system, t, q_s, q_f, v_s, v_f):
    """Consistent momenta; what the user's functions return is checked while tracing."""
    check_system(system, q_s, q_f)
    state = State(t, q_s, q_f, *legendre(system, q_s, q_f, v_s, v_f))
    return project_momentum(system, state, (v_s, v_f))[:2]


_projected_positions = jax.jit(project_positions)


@jax.jit
def _constraint_values(system, t, q_s, q_f):
    """All constraints, and the Jacobians of g by q_s, of g by q_f and of g_slow by q_s."""
    jacobians = *jax.jacrev(system.g, argnums=(1, 2))(t, q_s, q_f), jax.jacrev(system.g_slow, argnums=1)(t, q_s)
    return system.constraints(t, q_s, q_f), *jacobians


def check_constraints(
    system: System,
    state: State,
    what: str,
    tolerance: float = CONSTRAINT_TOLERANCE,
    advice: str = "start from initial_state(...).",
) -> None:
    """Refuse positions off the constraints, and constraints that cannot be kept where they are held."""
    if not system.is_constrained:
        return
    t, q_s, q_f = state.t, state.q_s, state.q_f
    values, slow, fast, alone = (np.asarray(a) for a in _constraint_values(system, t, q_s, q_f))
    if not np.isfinite(values).all():
        raise ValueError(f"{what}: the constraints are {values} there, which is not finite.")
    worst = np.abs(values).max()
    if worst > tolerance:
        raise ValueError(
            f"{what} violate the constraints by {worst:.3e} (row {np.abs(values).argmax()} of {values.size}, tolerance "
            f"{tolerance:.0e}); {advice}"
        )
    (n_g, n_s), (_, n_f), n_gs = slow.shape, fast.shape, len(alone)
    if n_gs > n_s:
        raise ValueError(
            f"System: slow_constraint returns {n_gs} values for {n_s} slow variables; at most {n_s} can be satisfied."
        )
    fix = (
        "A constraint held on the micro grid must be satisfiable by the fast variables: the slow ones have one value "
        "per macro step, so that a slow-only constraint held at every micro node is over-determined (rank deficit "
        "num_micro - 1)."
    )
    if n_g > n_f:
        raise ValueError(f"System: constraint returns {n_g} values for {n_f} fast variables. {fix} Remove rows.")
    if not (np.isfinite(slow).all() and np.isfinite(fast).all() and np.isfinite(alone).all()):
        raise ValueError("System: the Jacobian of the constraints is not finite at these positions (a norm at zero?).")
    size = np.linalg.norm(np.concatenate([slow, fast], axis=1), axis=1)
    slow_only = np.flatnonzero(np.linalg.norm(fast, axis=1) <= 1e-12 * size)
    if slow_only.size:
        raise ValueError(
            f"System: row(s) {slow_only.tolist()} of constraint do not depend on the fast variables q_f. {fix} "
            "Pass them as slow_constraint(q_s, params), which is held at the macro nodes."
        )
    for name, jacobian in (("slow_constraint", alone), ("constraint", fast)):
        rows = dependent_rows(jacobian)
        if not rows:
            continue
        # At a singular configuration (a linkage folded flat) rows are dependent at that place alone: runs pass it.
        near = _constraint_values(system, t, *_nearby(q_s, q_f))
        jacobian = np.asarray(near[3] if name == "slow_constraint" else near[2])
        if rows := dependent_rows(jacobian):
            of = "slow variables." if name == "slow_constraint" else f"fast variables. {fix}"
            raise ValueError(
                f"System: rows {rows} of {name} depend on each other: {len(jacobian)} rows have rank {row_rank(jacobian)} in the "
                f"{of} Remove redundant ones of these rows, or make the variables they need fast."
            )


def dependent_rows(jacobian) -> list[int]:
    """Numbers of the rows that take part in a linear dependence; rows count as of length one."""
    size = np.linalg.norm(jacobian, axis=1, keepdims=True)
    rows = jacobian / np.where(size > 0, size, 1)
    u, s, _ = np.linalg.svd(rows)
    null = u[:, np.count_nonzero(s > 1e-8) :]
    return np.flatnonzero(np.linalg.norm(null, axis=1) > 1e-6).tolist()


def _nearby(q_s, q_f):
    """A generic configuration about a hundredth of the size of these positions away, always the same."""
    random = np.random.default_rng(0)
    size = 1e-2 * max(1e-3, *(float(np.abs(q).max(initial=0.0)) for q in (q_s, q_f)))
    return tuple(q + size * random.normal(size=q.shape) for q in (q_s, q_f))


def row_rank(jacobian) -> int:
    """Rank of the rows, each scaled to length one."""
    size = np.linalg.norm(jacobian, axis=1, keepdims=True)
    return int(np.linalg.matrix_rank(jacobian / np.where(size > 0, size, 1), tol=1e-8))

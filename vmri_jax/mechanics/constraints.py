"""Checks of constraints and masses at one configuration (kept, independent, regular), and projection of positions onto the constraints."""

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import quickly_compiled
from vmri_jax.mechanics.by_name import constraint_sizes
from vmri_jax.mechanics.checks import CONSTRAINT_TOLERANCE
from vmri_jax.mechanics.functions import Rheonomic
from vmri_jax.mechanics.projection import legendre
from vmri_jax.mechanics.system import System

RANK = 1e-8
"""Largest singular value of a dependence among rows of length one. A larger value refuses nearly dependent constraints that can be solved."""
LEAST_EIGENVALUE = 1e-12
"""Smallest eigenvalue of a regular mass matrix, relative to the largest one. A larger value refuses large mass ratios."""
LEAST_COEFFICIENT = 1e-6
"""Rows with at least this coefficient in a normalised linear dependence are named in messages. A larger value leaves rows out."""
LEAST_FAST_PART = 1e-12
"""Least ratio ``|dg/dq_f| / |dg/dq|`` of a constraint that counts as dependent on fast variables. A larger value refuses weak dependences."""
PROJECTION_STEPS = 20
"""Gauss-Newton steps onto the constraints. They converge quadratically from close positions; a larger number takes longer."""
MICRO_GRID = (
    "A constraint held on the micro grid must be satisfiable by the fast variables: the slow path is one polynomial per macro step, of degree r, "
    "so that a slow-only constraint held at every micro node is over-determined (rank deficit r (num_micro - 1) per row)."
)


def rank_of(rows) -> tuple[int, list[int]]:
    """Rank of a matrix (k, n), with each row scaled to length one, and the indices of the rows in a linear dependence."""
    rows = np.asarray(rows)
    size = np.linalg.norm(rows, axis=1, keepdims=True)
    left, values, _ = np.linalg.svd(rows / np.where(size > 0, size, 1))
    rank = int(np.count_nonzero(values > RANK))
    return rank, np.flatnonzero(np.linalg.norm(left[:, rank:], axis=1) > LEAST_COEFFICIENT).tolist()


def is_rank_deficient(rows, scaled_with=None, tolerance: float = RANK):
    """Whether rows (k, n) are dependent, for compiled programs; False for k = 0, and if an entry is not finite.

    Args:
        rows: scaled to length one together with `scaled_with`.
        scaled_with: (k, m) further columns, which count for the scaling alone.
        tolerance: largest singular value of a dependence.
    """
    if rows.shape[0] == 0:
        return jnp.asarray(False)
    whole = rows if scaled_with is None else jnp.concatenate([rows, scaled_with], axis=1)
    size = jnp.linalg.norm(whole, axis=1, keepdims=True)
    values = jnp.linalg.svd(rows / jnp.where(size > 0, size, 1), compute_uv=False)
    too_many = rows.shape[0] > rows.shape[1]
    return jnp.isfinite(whole).all() & (too_many | (values[-1] <= tolerance))


def project_positions(system: System, t, q_s, q_f):
    """Positions moved onto the constraints at a time, along ``M^-1 G^T`` of the start: to first order the nearest point in the mass metric."""
    n_s = q_s.shape[0]
    q0 = jnp.concatenate([q_s, q_f])

    def constraints(q):
        return system.constraints(t, q[:n_s], q[n_s:])

    def momentum(v):
        return jnp.concatenate(legendre(system, q_s, q_f, v[:n_s], v[n_s:]))

    mass = jax.jacfwd(momentum)(jnp.zeros_like(q0))
    directions = jnp.linalg.solve(mass, jax.jacrev(constraints)(q0).T)

    # q <- q - D (G D)^+ g with D = M^-1 G^T at the start
    def corrected(_, q):
        g = constraints(q)
        return q - directions @ jnp.linalg.lstsq(jax.jacrev(constraints)(q) @ directions, g)[0]

    # a loop, since its body is compiled once
    q = jax.lax.fori_loop(0, PROJECTION_STEPS, corrected, q0)
    return q[:n_s], q[n_s:]


def check_mass(system: System, q_s, q_f) -> None:
    """Refuse a kinetic energy function whose mass matrix ``d2T/dv2`` is not positive definite at these positions.

    The matrix is taken at generic velocities: if T is not quadratic, it may be singular at rest.

    Raises:
        ValueError: the matrix is not finite or not positive definite; names the coordinates it leaves without mass.
    """
    if system.has_constant_mass:
        return
    with jax.ensure_compile_time_eval():  # velocities may be traced, positions are not
        mass = np.asarray(_mass_matrix(system, q_s, q_f, *_nearby(np.zeros_like(q_s), np.zeros_like(q_f))))
    if not np.isfinite(mass).all():
        raise ValueError(
            "System: the mass matrix d2T/dv2 of kinetic is not finite at these positions (a norm at zero?)."
        )
    values, vectors = np.linalg.eigh(mass)
    without = (
        np.abs(vectors[:, values <= LEAST_EIGENVALUE * np.abs(values).max()]).max(axis=1, initial=0.0)
        > LEAST_COEFFICIENT
    )
    if without.any():
        n_s = np.size(q_s)
        names = [f"q_s[{i}]" if i < n_s else f"q_f[{i - n_s}]" for i in np.flatnonzero(without)]
        raise ValueError(
            f"System: the mass matrix d2T/dv2 of kinetic is not positive definite at these positions, along {', '.join(names)} "
            f"(eigenvalues from {values[0]:.3g} to {values[-1]:.3g}). Give every coordinate a mass, one that constraints move too."
        )


@quickly_compiled
def _mass_matrix(system, q_s, q_f, v_s, v_f):
    n_s = v_s.size
    return jax.hessian(lambda v: system.kinetic(q_s, q_f, v[:n_s], v[n_s:], system.params))(jnp.append(v_s, v_f))


def check_constraints(
    system: System,
    state,
    place: str,
    tolerance: float = CONSTRAINT_TOLERANCE,
    advice: str = "start from initial_state(...).",
) -> None:
    """Refuse positions off the constraints, and constraints that cannot be kept where they are held.

    Args:
        state: a `State`.
        place: name of the positions in messages.
        tolerance: largest constraint value, in the unit of the constraint, of a satisfied constraint.
        advice: remedy in the message if a value is larger.

    Raises:
        ValueError: constraints that are not finite, not satisfied, too many, or dependent.
    """
    if not system.is_constrained:
        return

    def in_words(rows, name: str) -> str:
        arguments = (state.q_s,) if name == "slow_constraint" else (state.q_s, state.q_f)
        return _rows_in_words(getattr(system, name), rows, *arguments, system.params)

    values, implied, slow, fast, alone = jax.device_get(_values_and_jacobians(system, state.t, state.q_s, state.q_f))
    if not np.isfinite(values).all():
        raise ValueError(f"{place}: the constraints are {values} there, which is not finite.")
    worst, n_g = int(np.abs(values).argmax()), len(values) - len(alone)
    if abs(values[worst]) > tolerance:
        row = in_words([worst], "constraint") if worst < n_g else in_words([worst - n_g], "slow_constraint")
        raise ValueError(
            f"{place} violate {'constraint' if worst < n_g else 'slow_constraint'}, row {row.strip('[]')}, by {abs(values[worst]):.3e} (tolerance "
            f"{tolerance:.0e}); {advice}"
        )
    if system.implied is not None:
        _check_implied(implied, place)
    if not (np.isfinite(slow).all() and np.isfinite(fast).all() and np.isfinite(alone).all()):
        raise ValueError("System: the Jacobian of the constraints is not finite at these positions (a norm at zero?).")
    size = np.linalg.norm(np.concatenate([slow, fast], axis=1), axis=1)
    slow_only = np.flatnonzero(np.linalg.norm(fast, axis=1) <= LEAST_FAST_PART * size)
    if slow_only.size:
        raise ValueError(
            f"System: row(s) {in_words(slow_only, 'constraint')} of constraint do not depend on the fast variables q_f. {MICRO_GRID} "
            "Give them as System(slow_constraint=...), a function of (q_s, params), which is held at the macro nodes; or make the "
            "variables that they hold fast."
        )
    _check_counts(fast, alone)
    if any(dependent for _, dependent in map(rank_of, (alone, fast))):
        # At a singular configuration (a linkage folded flat) rows are dependent there and nowhere else, and runs pass it: only rows that are
        # dependent at a generic configuration nearby are refused.
        *_, fast, alone = jax.device_get(_values_and_jacobians(system, state.t, *_nearby(state.q_s, state.q_f)))
        _check_rank("slow_constraint", alone, "slow variables.", in_words)
        _check_rank("constraint", fast, f"fast variables. {MICRO_GRID}", in_words)


@quickly_compiled
def _values_and_jacobians(system, t, q_s, q_f):
    """Values of all constraints and of the implied rows, and the Jacobians dg/dq_s, dg/dq_f and dg_slow/dq_s."""
    jacobians = *jax.jacrev(system.g, argnums=(1, 2))(t, q_s, q_f), jax.jacrev(system.g_slow, argnums=1)(t, q_s)
    return system.constraints(t, q_s, q_f), system.g_implied(t, q_s, q_f), *jacobians


def _check_implied(values, place: str) -> None:
    opened = np.flatnonzero(~(np.abs(values) <= CONSTRAINT_TOLERANCE))
    if opened.size:
        raise ValueError(
            f"System: implied does not follow from the constraints: {place} keep these, and row(s) {opened.tolist()} of implied are "
            f"{values[opened]} there (tolerance {CONSTRAINT_TOLERANCE:.0e}). Take parameters for which they follow, or hold them "
            "as constraint."
        )


def _check_counts(fast, alone) -> None:
    (n_g, n_f), (n_gs, n_s) = fast.shape, alone.shape
    if n_gs > n_s:
        raise ValueError(
            f"System: slow_constraint returns {n_gs} values for {n_s} slow variables; at most {n_s} can be satisfied."
        )
    if n_g > n_f:
        raise ValueError(
            f"System: constraint returns {n_g} values for {n_f} fast variables; at most {n_f} can be satisfied. {MICRO_GRID} "
            "Remove rows, or make the variables that they hold fast."
        )


def _rows_in_words(constraint, rows, *arguments) -> str:
    """Numbers of the rows of a constraint, with the names of rows that the constraint returns by name: ``[0, 2]`` or ``0 (rope), 2 (rail)``."""
    if isinstance(constraint, Rheonomic):
        constraint, arguments = constraint.function, (0.0, *arguments)
    sizes = constraint_sizes(constraint, *arguments)
    if not sizes:
        return str([int(row) for row in rows])
    names = [name for name, size in sizes.items() for _ in range(size)]
    return ", ".join(f"{row} ({names[row]})" for row in rows)


def _check_rank(name: str, jacobian, of: str, in_words) -> None:
    rank, dependent = rank_of(jacobian)
    if dependent:
        raise ValueError(
            f"System: rows {in_words(dependent, name)} of {name} depend on each other: {len(jacobian)} rows have rank {rank} in the {of} Remove "
            "redundant ones of these rows, or make the variables they need fast."
        )


def _nearby(q_s, q_f):
    """A generic configuration about a hundredth of the size of these positions away, always the same."""
    random = np.random.default_rng(0)
    size = 1e-2 * max(1e-3, *(float(np.abs(q).max(initial=0.0)) for q in (q_s, q_f)))
    return tuple(q + size * random.normal(size=q.shape) for q in (q_s, q_f))

"""Checks of constraints and masses at one configuration (kept, independent, regular).

Rows are judged in their own units (`vmri_jax.mechanics.slopes`), mass matrices with a diagonal of ones.
"""

from contextlib import nullcontext
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import is_known, numbers_of, quickly_compiled, split_at
from vmri_jax.mechanics.by_name import constraint_sizes
from vmri_jax.mechanics.masses import correlation
from vmri_jax.mechanics.projection import mass_and_momentum
from vmri_jax.mechanics.slopes import ScaledRows, slopes_at, weights_of
from vmri_jax.mechanics.system import System
from vmri_jax.mechanics.terms import Term
from vmri_jax.refusals import Refused

START_TOLERANCE = 1e-9
"""Largest value of a row at the start, relative to its size. A larger one would start runs off the constraints; a
smaller one would refuse numbers that are written with ten digits."""
CONSTRAINT_TOLERANCE = 1e-6
"""Largest value of a row that is kept along a run, relative to its size.

A smaller value would refuse starts that are rounded to six digits.
"""
CONSTRAINT_OVER_TOLERANCE = 100
"""Loose Newton tolerances raise the value of a row that is kept, relative to its size, to this factor times the
tolerance. A smaller factor would refuse converged steps."""
RANK = 1e-8
"""Largest singular value of a dependence among rows of length one.

A larger value refuses nearly dependent constraints that can be solved.
"""
LEAST_EIGENVALUE = 1e-12
"""Smallest eigenvalue of a regular mass matrix with a diagonal of ones, relative to the largest one.

A larger value refuses nearly singular ones.
"""
SPEED = 1e-5
"""Velocity, in units of the user, at which the mass matrix is checked: it is the same at all velocities unless T is not
quadratic. T may then be singular at rest, or have a largest velocity, which this value has to stay below."""
LEAST_COEFFICIENT = 1e-6
"""Rows with at least this coefficient in a normalised linear dependence are named in messages.

A larger value leaves rows out.
"""
LEAST_FAST_PART = 1e-12
"""Least ratio ``|dg/dq_f| / |dg/dq|`` of a constraint that counts as dependent on fast variables.

A larger value refuses weak dependences.
"""
VANISHING_GRADIENT = 1e-6
"""Ratio of the gradient of a constraint to its gradient at a generic configuration nearby, below which the gradient
counts as zero. A larger value refuses constraints that are nearly singular at the start."""
NEARBY = 1e-2
"""Distance to a configuration nearby, relative to the distance over which rows change by their size.

From a larger one rows may be others.
"""
MICRO_GRID = (
    "A constraint held on the micro grid must be satisfiable by the fast variables: the slow path is one polynomial "
    "per macro step, of degree r, so that a slow-only constraint held at every micro node is over-determined (rank "
    "deficit r (num_micro - 1) per row)."
)


def decomposed(rows) -> tuple[np.ndarray, int, np.ndarray]:
    """U (k, k), the rank, and V^T (n, n) of the singular values of a matrix (k, n) with each row scaled to length
    one."""
    rows = np.asarray(rows)
    size = np.linalg.norm(rows, axis=1, keepdims=True)
    left, values, right = np.linalg.svd(rows / np.where(size > 0, size, 1))
    return left, int(np.count_nonzero(values > RANK)), right


def rank_of(rows) -> tuple[int, list[int]]:
    """Rank of a matrix (k, n), with each row scaled to length one, and the indices of the rows in a linear
    dependence."""
    left, rank, _ = decomposed(rows)
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


def are_kept(rows: ScaledRows, solved: int, tolerance):
    """Whether a state of a run keeps the first `solved` rows, for which steps solve, and the implied ones after them,
    with the tolerance of the solver."""
    tolerance = jnp.maximum(CONSTRAINT_TOLERANCE, CONSTRAINT_OVER_TOLERANCE * tolerance)
    kept = jnp.abs(rows.values) <= rows.allowed(tolerance, solved)
    return jnp.all(kept[:solved]), jnp.all(kept[solved:])


class Configuration(NamedTuple):
    """The `ScaledRows` at a configuration, the mass matrix, and of the rows that are solved for the values g, the
    Jacobian G, and dg/dt."""

    rows: ScaledRows
    mass: Any
    values: Any
    jacobian: Any
    rates: Any


def configuration(system: System, t, q_s, q_f, mass=None) -> Configuration:
    """The `Configuration`, with the mass matrix at rest unless it is given: of numbers, one program for the projection
    of a start, its momenta, and its checks."""
    if mass is None:
        mass, _ = mass_and_momentum(system, q_s, q_f, np.zeros(np.shape(q_s)), np.zeros(np.shape(q_f)))
    solved = sum(system.num_constraints(q_s, q_f))
    rows, *of_all = numbers_of(_rows_and_slopes(system, t, q_s, q_f, weights_of(mass.diagonal())))
    return Configuration(rows, mass, *(a[:solved] for a in of_all))


@quickly_compiled
def _rows_and_slopes(system, t, q_s, q_f, weights):
    slopes = slopes_at(system, t, q_s, q_f)
    return slopes.scaled(weights), slopes.values, slopes.jacobian, slopes.rates


def check_mass(system: System, q_s, q_f) -> None:
    """Refuse a kinetic energy function whose mass matrix ``d2T/dv2`` is not positive definite at these positions.

    The matrix is taken at generic velocities: if T is not quadratic, it may be singular at rest.

    Raises:
        ValueError: the matrix is not finite or not positive definite; names the coordinates it leaves without mass.
    """
    if system.has_constant_mass:
        return
    # velocities may be traced, positions are not; outside of traces each operation would be a program of its own
    with nullcontext() if is_known(()) else jax.ensure_compile_time_eval():
        random = np.random.default_rng(0)
        velocities = (SPEED * random.normal(size=np.size(q)) for q in (q_s, q_f))
        mass, _ = mass_and_momentum(system, q_s, q_f, *velocities)
    if not np.isfinite(mass).all():
        raise Refused("System: the mass matrix d2T/dv2 of kinetic is not finite at these positions (a norm at zero?).")
    values, vectors = np.linalg.eigh(correlation(mass))
    without = (
        np.abs(vectors[:, values <= LEAST_EIGENVALUE * np.abs(values).max()]).max(axis=1, initial=0.0)
        > LEAST_COEFFICIENT
    )
    if without.any():
        n_s = np.size(q_s)
        names = [f"q_s[{i}]" if i < n_s else f"q_f[{i - n_s}]" for i in np.flatnonzero(without)]
        raise Refused(
            "System: the mass matrix d2T/dv2 of kinetic is not positive definite at these positions, along "
            f"{', '.join(names)} (with a diagonal of ones, its eigenvalues go from {values[0]:.3g} to "
            f"{values[-1]:.3g}). Give every coordinate a mass, one that constraints move too."
        )


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
        tolerance: largest value of a satisfied constraint, relative to its size.
        advice: remedy in the message if a value is larger.

    Raises:
        ValueError: constraints that are not finite, not satisfied, too many, or dependent.
    """
    if not system.is_constrained:
        return
    held, (rows, mass, solved, *_) = _held(system, state), configuration(system, state.t, state.q_s, state.q_f)
    weights = weights_of(mass.diagonal())
    if not np.isfinite(solved).all():
        raise Refused(f"{place}: the constraints are {solved} there, which is not finite.")
    if not np.isfinite(rows.gradients).all():
        raise Refused("System: the Jacobian of the constraints is not finite at these positions (a norm at zero?).")
    allowed = rows.allowed(tolerance, len(solved))[: len(solved)]
    violated = np.abs(solved) > allowed
    if violated.any():
        _check_gradients(system, state, held, rows, weights)  # of a square, which no start fulfils to round-off
        worst = int(np.argmax(np.abs(solved) / np.where(violated, allowed, np.inf)))
        [part] = [part for part in held if part.rows.start <= worst < part.rows.stop]
        raise Refused(
            f"{place} violate {part.term.field}, row {part.in_words([worst - part.rows.start]).strip('[]')}, by "
            f"{abs(solved[worst]):.3e} (allowed: {allowed[worst]:.0e}, {tolerance:.0e} of its size, and round-off); "
            f"{advice}"
        )
    implied, allowed = (a[len(solved) :] for a in (rows.values, rows.allowed(CONSTRAINT_TOLERANCE, len(solved))))
    opened = np.flatnonzero(~(np.abs(implied) <= allowed))
    if opened.size:
        raise Refused(
            f"System: implied does not follow from the constraints: {place} keep these, and row(s) {opened.tolist()} "
            f"of implied are {implied[opened]} there (allowed: {allowed[opened]}). Take parameters for which they "
            "follow, or hold them as constraint."
        )
    for part in held:
        by_all, by_variables = rows.gradients[part.rows], rows.gradients[part.rows, part.variables]
        size = np.linalg.norm(by_all, axis=1)
        slow_only = np.flatnonzero((size > 0) & (np.linalg.norm(by_variables, axis=1) <= LEAST_FAST_PART * size))
        if slow_only.size:
            raise Refused(
                f"System: row(s) {part.in_words(slow_only)} of constraint do not depend on the fast variables q_f. "
                f"{MICRO_GRID} Give them as System(slow_constraint=...), a function of (q_s, params), which is held "
                "at the macro nodes; or make the variables that they hold fast."
            )
        (values, variables), pace = by_variables.shape, part.pace
        if values > variables:
            raise Refused(
                f"System: {part.term.field} returns {values} values for {variables} {pace} variables; at most "
                f"{variables} can be satisfied.{part.grid} Remove rows, or make the variables that they hold {pace}."
            )
    _check_gradients(system, state, held, rows, weights)
    if any(rank_of(rows.gradients[part.rows, part.variables])[1] for part in held):
        # At a singular configuration (a linkage folded flat) rows are dependent there and nowhere else, and runs pass
        # it: only rows that are dependent at a generic configuration nearby are refused.
        rows = configuration(system, state.t, *_nearby(state, rows, weights)).rows
        for part in held:
            jacobian = rows.gradients[part.rows, part.variables]
            rank, dependent = rank_of(jacobian)
            if dependent:
                raise Refused(
                    f"System: rows {part.in_words(dependent)} of {part.term.field} depend on each other: "
                    f"{len(jacobian)} rows have rank {rank} in the {part.pace} variables.{part.grid} Remove redundant "
                    "ones of these rows, or make the variables they need fast."
                )


class Held(NamedTuple):
    """A constraint at a state.

    values: t, q_s and q_f by name, and the params.
    rows: its rows among those that are solved for.
    variables: the coordinates among (q_s, q_f) that can satisfy it: those of its pace.
    pace: "slow" or "fast".
    grid: its grid in messages, with a space before; empty for the macro grid.
    """

    term: Term
    values: dict[str, Any]
    rows: slice
    variables: slice
    pace: str
    grid: str

    def in_words(self, rows) -> str:
        """Numbers of some of its rows, with the names of rows that the constraint returns by name: ``[0, 2]`` or
        ``0 (rope), 2 (rail)``."""
        sizes = constraint_sizes(self.term.function, *self.term.of_arguments(self.values), self.values["params"])
        names = [name for name, size in sizes.items() for _ in range(size)]
        return ", ".join(f"{row} ({names[row]})" for row in rows) if names else str(list(map(int, rows)))


def _held(system: System, state) -> list[Held]:
    """The constraints of a system at a state."""
    n_s, (n_g, n_gs) = np.size(state.q_s), system.num_constraints(state.q_s, state.q_f)
    parts = {
        "constraint": (slice(0, n_g), slice(n_s, None), "fast", f" {MICRO_GRID}"),
        "slow_constraint": (slice(n_g, n_g + n_gs), slice(0, n_s), "slow", ""),
    }
    values = {"t": state.t, "q_s": state.q_s, "q_f": state.q_f, "params": system.params}
    return [Held(term, values, *parts[term.field]) for term in system.of_kind("constraint")]


def _check_gradients(system: System, state, held: list[Held], rows: ScaledRows, weights) -> None:
    """Refuse rows whose gradient is zero at the state, but not at a generic configuration `NEARBY` relative to its
    positions."""
    q = np.concatenate([state.q_s, state.q_f])
    change = NEARBY * np.abs(weights * q).max() * np.random.default_rng(0).normal(size=q.size) / weights
    nearby = configuration(system, state.t, *split_at(q + change, np.size(state.q_s))).rows
    size, size_nearby = (np.linalg.norm(a.gradients, axis=1) for a in (rows, nearby))
    vanishes = (size_nearby > 0) & (size <= VANISHING_GRADIENT * size_nearby)
    for part in held:
        if vanishes[part.rows].any():
            raise Refused(
                f"System: the gradient of row(s) {part.in_words(np.flatnonzero(vanishes[part.rows]))} of "
                f"{part.term.field} vanishes at these positions, and no force along it can hold the constraint. A "
                "square, (|x| - L)**2, has such a gradient wherever it is 0: take its root, |x| - L."
            )


def _nearby(state, rows: ScaledRows, weights):
    """A generic configuration at a distance `NEARBY` from a state, always the same; the distance over which a row
    changes by its size is 1."""
    lengths = np.linalg.norm(rows.gradients, axis=1)
    size = NEARBY * np.min(rows.sizes[lengths > 0] / lengths[lengths > 0], initial=np.inf)
    change = np.where(np.isfinite(size), size, 0.0) * np.random.default_rng(0).normal(size=weights.size) / weights
    return split_at(np.concatenate([state.q_s, state.q_f]) + change, np.size(state.q_s))

"""Sparsity of ``G M^-1 G^T``, from the coordinates that constraints share; it is determined once, before a run."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.kernels.band import Full, Sparsity, sparsity
from vmri_jax.mechanics.arrays import is_concrete, quickly_compiled, split_at
from vmri_jax.mechanics.system import System

MOST_ROWS_OF_FULL_MATRIX = 80
"""Number of constraint rows up to which the full matrix is used, without a search for zeros. For hinged chains in
director coordinates the band takes 0.9 of the time of the full matrix at 77 rows, and 0.3 of it at 88
(`python -m benchmarks chains --full`). A larger number makes steps of short chains slower; a smaller one makes the
first run of small systems some seconds longer."""
LEAST_CHANGE = 1e-6
"""Least change of a constraint, relative to its largest change, that counts as a dependence. A larger value misses weak
dependences, which costs iterations; a smaller one takes round-off for a dependence."""


def all_rows(system: System, q_s, q_f) -> Sparsity:
    """Sparsity of ``G M^-1 G^T`` with all constraints, for coordinates of these shapes."""
    count = sum(system.num_constraints(q_s, q_f))
    if count <= MOST_ROWS_OF_FULL_MATRIX or not (system.has_constant_mass and system.kinetic.is_diagonal):
        return Full(count)
    return _shared(system, q_s.shape[0], q_f.shape[0])


def fast_rows(system: System, q_s, q_f, degree: int) -> Sparsity:
    """Sparsity of ``G_f M_f^-1 G_f^T`` with the constraints g and the fast coordinates, at the nodes of one interval;
    for diagonal masses."""
    count = system.num_constraints(q_s, q_f)[0]
    if count <= MOST_ROWS_OF_FULL_MATRIX:
        return Full(degree * count)
    return _shared(system, q_s.shape[0], q_f.shape[0], degree)


def _shared(system: System, n_s: int, n_f: int, nodes: int | None = None) -> Sparsity:
    """Sparsity of the matrix: two rows have a common entry if both constraints change with some coordinate, at a random
    position.

    A dependence that this test misses costs iterations, not accuracy: the matrix serves Newton's iteration alone. With
    a number of `nodes` it is the matrix of g with the fast coordinates, else of all constraints with all coordinates.
    """
    rng = np.random.default_rng(0)
    # random numbers in place of traced ones
    system = jax.tree.map(lambda leaf: leaf if is_concrete(leaf) else rng.uniform(0.5, 1.5, np.shape(leaf)), system)
    q, moves = rng.normal(size=n_s + n_f), np.diag(rng.normal(size=n_s + n_f))
    with jax.ensure_compile_time_eval():
        touched, finite = _touched(system, n_s, q, moves if nodes is None else moves[n_s:], nodes is None)
    rows = (np.asarray(touched).T | ~np.asarray(finite)[:, None]).astype(np.int32)
    return sparsity(rows @ rows.T > 0, nodes or 1)


@partial(quickly_compiled, static_argnames=("n_s", "slow_too"))
def _touched(system: System, n_s: int, q, moves, slow_too: bool):
    """(k, m) whether each of m constraints changes to first order with each of the moves (k, n), and (m,) whether it is
    finite."""

    def constraints(q):
        values = system.constraints if slow_too else system.g
        return values(jnp.zeros(()), *split_at(q, n_s))

    values, change = jax.linearize(constraints, q)
    changes = jnp.abs(jax.lax.map(change, moves))
    return changes > LEAST_CHANGE * jnp.max(changes, axis=0), jnp.isfinite(values) & jnp.isfinite(changes).all(axis=0)

"""Which constraints share coordinates: the zeros of ``G M^-1 G^T``, found before anything is computed with it."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.kernels import Full, Sparsity, sparsity
from vmri_jax.mechanics.arrays import is_concrete
from vmri_jax.mechanics.masses import ConstantMass, Diagonal
from vmri_jax.mechanics.system import System

FEW = 80
"""Rows of constraints up to which the full matrix is taken and no zeros are looked for. Of hinged chains by directors the band takes
0.9 of the time of the full matrix at 77 rows, and 0.3 of it at 88 (`python -m benchmarks chains --full`). With a larger number short chains take
longer for a step, with a smaller one the first run of small systems takes some seconds longer."""
CHANGE = 1e-6
"""Part of the largest value of a constraint from which a change counts."""


def all_rows(system: System, q_s, q_f) -> Sparsity:
    """Of ``G M^-1 G^T`` with all constraints and all coordinates of these shapes."""
    count = sum(system.num_constraints(q_s, q_f))
    diagonal = isinstance(system.kinetic, ConstantMass) and all(
        isinstance(mass, Diagonal) for mass in (system.kinetic.slow_mass, system.kinetic.fast_mass)
    )
    if count <= FEW or not diagonal:
        return Full(count)
    return _shared(system, q_s.shape[0], q_f.shape[0])


def fast_rows(system: System, q_s, q_f, degree: int) -> Sparsity:
    """Of the same with the fast constraints g and the fast coordinates, at the nodes of one interval.

    Only for masses that are diagonal.
    """
    count = system.num_constraints(q_s, q_f)[0]
    if count <= FEW:
        return Full(degree * count)
    return _shared(system, q_s.shape[0], q_f.shape[0], degree)


def _shared(system: System, n_s: int, n_f: int, nodes: int | None = None) -> Sparsity:
    """From changes of the constraints with each coordinate, at a random position: of g with q_f at `nodes` nodes, else of all.

    A change that is missed costs iterations, not accuracy: the matrix is only that of Newton's iteration.
    """
    rng = np.random.default_rng(0)
    arrays, rest = eqx.partition(system, eqx.is_array_like)
    system = eqx.combine(jax.tree.map(partial(_known, rng), arrays), rest)
    q, moves = rng.normal(size=n_s + n_f), np.diag(rng.normal(size=n_s + n_f))
    with jax.ensure_compile_time_eval():
        touched, finite = _touched(system, n_s, q, moves if nodes is None else moves[n_s:], nodes is None)
    rows = (np.asarray(touched).T | ~np.asarray(finite)[:, None]).astype(np.int32)
    return sparsity(rows @ rows.T > 0, nodes or 1)


@eqx.filter_jit
def _touched(system: System, n_s: int, q, moves, slow_too: bool):
    """Which constraints change with each of these moves (k, n), (k, m), and which are finite, (m,)."""

    def constraints(q):
        values = system.constraints if slow_too else system.g
        return values(jnp.zeros(()), q[:n_s], q[n_s:])

    before = constraints(q)
    after = jax.lax.map(lambda move: constraints(q + move), moves)
    return jnp.abs(after - before) > CHANGE * jnp.max(jnp.abs(before)), jnp.isfinite(before)


def _known(rng, leaf):
    """A leaf as it is, or random numbers where it is traced."""
    return leaf if is_concrete(leaf) else rng.uniform(0.5, 1.5, np.shape(leaf))

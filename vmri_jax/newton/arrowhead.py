"""Newton direction by a block march plus a border solve: exact, O(num_micro) in time and memory.

Unknowns are ordered as border (slow increments and slow multipliers) and chain (one block per micro interval:
its fast increments and multipliers). The rows of micro interval m see the border, its own unknowns and, through
the position where it starts and the momentum that arrives there, everything before it and nothing after: the chain
is block lower triangular. So one forward march expresses position and momentum at every micro node as affine
functions of the slow increments; inserted into the slow equations they leave a small border system.
"""

import jax
import jax.numpy as jnp

from vmri_jax.equations import Unknowns
from vmri_jax.linearization import Blocks


def solve(blocks: Blocks, residual: Unknowns) -> Unknowns:
    """The direction ``-matrix^-1 residual`` by forward march, border solve and back substitution."""
    n, r, n_f = residual.fast.shape
    n_g, n_s = residual.multiplier.shape[2], residual.slow.shape[1]
    border = r * n_s

    def affine(constant, linear):
        """Affine function of the slow increments as an array with columns [constant, one per increment]."""
        return jnp.concatenate([constant[..., None], linear], axis=-1)

    def chain_matrix(ff, g_f):
        """Rows [fast slots 0..r-1, g at nodes 1..r] against [increments 1..r, multipliers 0..r-1] of one interval."""
        nodes = jnp.eye(r)
        top_right = -jnp.einsum("jga,ji->jaig", g_f[:-1], nodes).reshape(r * n_f, r * n_g)
        bottom_left = jnp.einsum("jga,ji->jgia", g_f[1:], nodes).reshape(r * n_g, r * n_f)
        top_left = ff[:-1, :, 1:].reshape(r * n_f, r * n_f)
        return jnp.block([[top_left, top_right], [bottom_left, jnp.zeros((r * n_g, r * n_g))]])

    inverse = jnp.linalg.inv(jax.vmap(chain_matrix)(blocks.ff, blocks.g_f))

    def march(carry, interval):
        start, incoming, slow_rows = carry  # affine: position and momentum arriving here, slow equations so far
        b, inverse, res = interval
        slots = jnp.einsum("iab,bk->iak", b.ff[:, :, 0], start) + affine(
            jnp.zeros((r + 1, n_f)), b.fs.reshape(r + 1, n_f, border)
        )
        rows = slots[:-1].at[0].add(incoming).at[..., 0].add(res.fast)
        slow_at = jnp.einsum("ji,ab->jaib", b.basis[1:, 1:], jnp.eye(n_s)).reshape(r, n_s, border)
        g_rows = jnp.einsum("jga,ak->jgk", b.g_f[1:], start) + affine(res.multiplier, b.g_s[1:] @ slow_at)
        solution = -inverse @ jnp.concatenate([rows.reshape(r * n_f, 1 + border), g_rows.reshape(r * n_g, 1 + border)])
        fast = solution[: r * n_f].reshape(r, n_f, 1 + border)
        multiplier = solution[r * n_f :].reshape(r, n_g, 1 + border)

        outgoing = slots[-1] + jnp.einsum("ajb,jbk->ak", b.ff[-1, :, 1:], fast)
        slow_rows += jnp.einsum("iab,bk->iak", b.sf[:-1, :, 0], start)
        slow_rows += jnp.einsum("iajb,jbk->iak", b.sf[:-1, :, 1:], fast)
        slow_rows -= jnp.einsum("ji,jga,jgk->iak", b.basis[:-1, :-1], b.g_s[:-1], multiplier)
        return (start + fast[-1], outgoing, slow_rows), solution

    ss = blocks.ss[:-1].reshape(r, n_s, border)
    zero = jnp.zeros((n_f, 1 + border))
    per_interval = Blocks(blocks.ff, blocks.fs, blocks.sf, None, blocks.g_s, blocks.g_f, None, blocks.basis)
    chain_residual = Unknowns(None, None, residual.fast, residual.multiplier)
    (_, _, slow_rows), solutions = jax.lax.scan(
        march, (zero, zero, affine(residual.slow, ss)), (per_interval, inverse, chain_residual)
    )

    d_slow, d_slow_multiplier = _solve_border(blocks, slow_rows, residual.slow_multiplier, n)
    columns = jnp.concatenate([jnp.ones(1), d_slow.reshape(-1)])
    chain = solutions @ columns
    return Unknowns(
        slow=d_slow,
        slow_multiplier=d_slow_multiplier,
        fast=chain[:, : r * n_f].reshape(n, r, n_f),
        multiplier=chain[:, r * n_f :].reshape(n, r, n_g),
    )


def _solve_border(blocks: Blocks, slow_rows, g_slow_residual, num_micro: int):
    """Slow increments and multipliers from the slow equations, affine in the increments, and g_s."""
    r, n_s, _ = slow_rows.shape
    n_gs = g_slow_residual.shape[1]
    if n_s == 0:
        return jnp.zeros((r, 0)), jnp.zeros((r, n_gs))
    nodes = jnp.eye(r)
    force = -jnp.einsum("iga,ij->iajg", blocks.g_slow[:-1], nodes).reshape(r * n_s, r * n_gs) / num_micro
    jacobian = jnp.einsum("iga,ij->igja", blocks.g_slow[1:], nodes).reshape(r * n_gs, r * n_s)
    rows = slow_rows.reshape(r * n_s, 1 + r * n_s)
    matrix = jnp.block([[rows[:, 1:], force], [jacobian, jnp.zeros((r * n_gs, r * n_gs))]])
    solution = jnp.linalg.solve(matrix, -jnp.concatenate([rows[:, 0], g_slow_residual.reshape(-1)]))
    return solution[: r * n_s].reshape(r, n_s), solution[r * n_s :].reshape(r, n_gs)

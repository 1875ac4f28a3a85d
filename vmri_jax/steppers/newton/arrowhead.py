"""Newton direction by a block march plus a border solve: exact, O(num_micro) in time and memory.

Unknowns are ordered as border (slow increments and slow multipliers) and chain (one block per micro interval:
its fast increments and multipliers). The rows of micro interval m see the border, its own unknowns and, through
the position where it starts and the momentum that arrives there, everything before it and nothing after: the chain
is block lower triangular. So a forward march gives the response of the chain to the residual, and another one its
response to each slow increment; inserted into the slow equations they leave a small border system.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vmri_jax.schemes.equations import StepEquations, Unknowns
from vmri_jax.steppers.newton.linearization import Blocks, linearize
from vmri_jax.steppers.newton.null_space import inverse_with_multipliers


class Factors(NamedTuple):
    """What does not depend on the residual.

    chain: inverse of each chain block, k = r (n_f + n_g)
    response: of the chain unknowns to the slow increments
    border: inverse of the slow equations once the chain is eliminated
    """

    blocks: Blocks
    chain: Float[Array, "num_micro k k"]
    response: Float[Array, "num_micro k r*n_s"]
    border: Float[Array, "b b"]


def factor(equations: StepEquations, x: Unknowns, inverse: Callable = inverse_with_multipliers) -> Factors:
    """Eliminate the chain of the matrix at x.

    Args:
        inverse: of the blocks ``[[A, -G_0^T], [G_1, 0]]`` of the micro intervals and of the border, see `null_space`.
    """
    blocks = linearize(equations, x)
    n, r, n_f = x.fast.shape
    n_s, n_g = x.slow.shape[1], x.multiplier.shape[2]
    border = r * n_s
    chain = inverse(blocks.ff[:, :-1, :, 1:].reshape(n, r * n_f, r * n_f), blocks.g_f[:, :-1], blocks.g_f[:, 1:])

    slots = blocks.fs.reshape(n, r + 1, n_f, border)
    g = jnp.einsum("mji,mjgb->mjgib", blocks.basis[:, 1:, 1:], blocks.g_s[:, 1:]).reshape(n, r, n_g, border)
    response, slow_rows = _march(blocks, chain, slots, g)

    slow = (slow_rows + blocks.ss[:-1].reshape(r, n_s, border)).reshape(border, border)
    return Factors(blocks, chain, response, inverse(slow, blocks.g_slow[:-1] / n, blocks.g_slow[1:]))


def solve(factors: Factors, residual: Unknowns) -> Unknowns:
    """The direction ``-matrix^-1 residual``."""
    blocks, chain, response, border = factors
    slots = jnp.pad(residual.fast, [(0, 0), (0, 1), (0, 0)])[..., None]
    own, slow_rows = _march(blocks, chain, slots, residual.multiplier[..., None])
    slow_rows = residual.slow + slow_rows[..., 0]
    rows = jnp.concatenate([slow_rows.reshape(-1), residual.slow_multiplier.reshape(-1)])
    d_slow, d_slow_multiplier = jnp.split(-border @ rows, [residual.slow.size])
    d_chain = own[..., 0] + response @ d_slow
    d_fast, d_multiplier = jnp.split(d_chain, [residual.fast[0].size], axis=1)
    return Unknowns(
        d_slow.reshape(residual.slow.shape),
        d_slow_multiplier.reshape(residual.slow_multiplier.shape),
        d_fast.reshape(residual.fast.shape),
        d_multiplier.reshape(residual.multiplier.shape),
    )


def _march(blocks: Blocks, chain, slots, g):
    """Chain unknowns that cancel given changes of the fast slots and of g, interval after interval.

    Args:
        slots: (num_micro, r + 1, n_f, c) changes of the fast slots, one column each.
        g: (num_micro, r, n_g, c) changes of the constraints at nodes 1..r.

    Returns:
        The chain unknowns (num_micro, r (n_f + n_g), c) and the change (r, n_s, c) they cause in the slow equations.
    """
    _, r, n_g, c = g.shape
    n_f, n_s = slots.shape[2], blocks.sf.shape[2]

    def interval(carry, at):
        start, incoming, slow_rows = carry  # changes of the position and momentum that arrive at this interval
        b, chain, slots, g = at
        slots = slots + jnp.einsum("iab,bc->iac", b.ff[:, :, 0], start)
        rows = slots[:-1].at[0].add(incoming).reshape(r * n_f, c)
        g_rows = (g + jnp.einsum("jga,ac->jgc", b.g_f[1:], start)).reshape(r * n_g, c)
        unknowns = -chain @ jnp.concatenate([rows, g_rows])
        fast, multiplier = unknowns[: r * n_f].reshape(r, n_f, c), unknowns[r * n_f :].reshape(r, n_g, c)

        outgoing = slots[-1] + jnp.einsum("ajb,jbc->ac", b.ff[-1, :, 1:], fast)
        slow_rows += jnp.einsum("iab,bc->iac", b.sf[:-1, :, 0], start)
        slow_rows += jnp.einsum("iajb,jbc->iac", b.sf[:-1, :, 1:], fast)
        slow_rows -= jnp.einsum("ji,jga,jgc->iac", b.basis[:-1, :-1], b.g_s[:-1], multiplier)
        return (start + fast[-1], outgoing, slow_rows), unknowns

    per_interval = blocks._replace(fs=None, ss=None, g_slow=None)
    zero = jnp.zeros((n_f, c))
    carry = (zero, zero, jnp.zeros((r, n_s, c)))
    (_, _, slow_rows), unknowns = jax.lax.scan(interval, carry, (per_interval, chain, slots, g))
    return unknowns, slow_rows

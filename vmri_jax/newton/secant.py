"""Secant pairs: what an iteration has learned about its own map, to correct its next updates (Anderson's method).

An iteration ``x <- x + d(x)`` with a cheap matrix leaves out a part of the derivative of d. Pairs of changes of x and
of d measure it: the best combination of pairs that cancels d says where to go instead. Pairs are kept from step to step,
as in the interface quasi-Newton methods of fluid-structure interaction (Degroote, Bathe, Vierendeels 2009).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

SIZE = 4
"""Pairs that are kept."""
FILTER = 1e-3
"""A pair is left out where less than this part of it (squared) is not in the span of newer ones."""


class Pairs(NamedTuple):
    """moves, changes (size, n): of x and of d between two iterations, the last pair first, changes of length one.

    Lengths and fits are those of the first `measured` entries: the others (multipliers) have another unit.
    """

    moves: Any
    changes: Any

    @classmethod
    def none(cls, n: int, size: int = SIZE) -> "Pairs":
        return cls(jnp.zeros((size, n)), jnp.zeros((size, n)))

    def add(self, move, change, noise, measured: int) -> "Pairs":
        """With one more pair, unless its change is below the noise."""
        length = jnp.sqrt(jnp.sum(change[:measured] ** 2))
        scale = 1 / jnp.where(length > noise, length, 1.0)
        new = self._with_first(scale * move, scale * change)
        return Pairs(*(jnp.where(length > noise, a, b) for a, b in zip(new, self, strict=True)))

    def corrected(self, d, measured: int):
        """The update d with what the pairs know: ``d - sum_j w_j (move_j + change_j)``, w the best fit of the changes to d."""

        def orthogonal(found: Pairs, pair: Pairs):
            """Gram-Schmidt: the pair without what newer ones contain."""
            along = jnp.sum(found.changes[:, :measured] * pair.changes[:measured], axis=1)[:, None]
            move, change = (a - jnp.sum(along * b, axis=0) for a, b in zip(pair, found, strict=True))
            square = jnp.sum(change[:measured] ** 2)
            scale = jnp.where(square > FILTER, jax.lax.rsqrt(square), 0.0)
            return found._with_first(scale * move, scale * change), None

        pairs, _ = jax.lax.scan(orthogonal, jax.tree.map(jnp.zeros_like, self), self)
        w = jnp.sum(pairs.changes[:, :measured] * d[:measured], axis=1)[:, None]
        return d - jnp.sum(w * (pairs.moves + pairs.changes), axis=0)

    def _with_first(self, move, change) -> "Pairs":
        return Pairs(*(jnp.concatenate([a[None], b[:-1]]) for a, b in zip((move, change), self, strict=True)))

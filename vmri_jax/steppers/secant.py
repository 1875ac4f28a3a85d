"""Secant pairs: what an iteration has learned about its own map, to correct its next updates (Anderson's method).

An iteration ``x <- x + d(x)`` with a cheap matrix leaves out a part of the derivative of d. Pairs of changes of x and
of d measure it: the best combination of pairs that cancels d says where to go instead. Pairs are kept from step to step,
as in the interface quasi-Newton methods of fluid-structure interaction (Degroote, Bathe, Vierendeels 2009).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

SIZE = 4
"""Pairs that are kept."""
FILTER = 1e-3
"""A pair is left out where less than this part of it (squared) is not in the span of newer ones."""


class Pairs(NamedTuple):
    """Moves of x and changes of d between two iterations, the last pair first, changes of length one.

    Lengths and fits are those of the first `measured` entries: the others (multipliers) have another unit.
    """

    moves: Float[Array, "size n"]
    changes: Float[Array, "size n"]

    @classmethod
    def none(cls, n: int, size: int = SIZE) -> "Pairs":
        """Nothing learned of n unknowns yet."""
        return cls(jnp.zeros((size, n)), jnp.zeros((size, n)))

    def add(self, move, change, noise, measured: int) -> "Pairs":
        """With one more pair (n,), (n,), unless its change is below the noise."""
        length = jnp.sqrt(jnp.sum(change[:measured] ** 2))
        scale = 1 / jnp.where(length > noise, length, 1.0)
        new = Pairs(
            jnp.concatenate([scale * move[None], self.moves[:-1]]),
            jnp.concatenate([scale * change[None], self.changes[:-1]]),
        )
        return Pairs(*(jnp.where(length > noise, a, b) for a, b in zip(new, self, strict=True)))

    def corrected(self, d, measured: int):
        """The update d with what the pairs know: ``d - sum_j w_j (move_j + change_j)``, w the best fit to d."""
        size = len(self.changes)
        seen = jnp.concatenate([self.changes, d[None]])[:, :measured]
        rows = jnp.stack([jnp.sum(seen * pair, axis=-1) for pair in seen[:-1]])
        eliminated = []
        for _ in range(size):  # normal equations; the pivot is what newer pairs do not contain
            row = jnp.where(rows[0, 0] > FILTER, rows[0, 1:] / rows[0, 0], 0.0)
            rows = rows[1:, 1:] - rows[1:, :1] * row
            eliminated.append(row)
        w = jnp.zeros(0)
        for row in eliminated[::-1]:
            w = jnp.concatenate([row[-1:] - jnp.sum(row[:-1] * w, keepdims=True), w])
        return d - jnp.sum(w[:, None] * (self.moves + self.changes), axis=0)

"""Secant pairs: what an iteration has learned about its own map, to correct its next updates (Anderson's method).

An iteration ``x <- x + d(x)`` with a cheap matrix leaves out a part of the derivative of d. Pairs of changes of x and
of d measure it: the best combination of pairs that cancels d says where to go instead. Pairs are kept from step to step,
as in the interface quasi-Newton methods of fluid-structure interaction (Degroote, Bathe, Vierendeels 2009).
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

SIZE = 4
"""Pairs that are kept."""
FILTER = 1e-3
"""A pair is left out where less than this part of it (squared) is not in the span of newer ones."""


class Pairs(NamedTuple):
    """moves, changes (SIZE, n): of x and of d between two iterations, the last pair first, changes of length one.

    Lengths and fits are those of the first `measured` entries: the others (multipliers) have another unit.
    """

    moves: Any
    changes: Any

    @classmethod
    def none(cls, n: int) -> "Pairs":
        return cls(jnp.zeros((SIZE, n)), jnp.zeros((SIZE, n)))

    def add(self, move, change, noise, measured: int) -> "Pairs":
        """With one more pair, unless its change is below the noise."""
        length = jnp.sqrt(jnp.sum(change[:measured] ** 2))
        scale = 1 / jnp.where(length > noise, length, 1.0)
        new = Pairs(
            jnp.concatenate([scale * move[None], self.moves[:-1]]),
            jnp.concatenate([scale * change[None], self.changes[:-1]]),
        )
        return Pairs(*(jnp.where(length > noise, a, b) for a, b in zip(new, self, strict=True)))

    def corrected(self, d, measured: int):
        """The update d with what the pairs know: ``d - sum_j w_j (move_j + change_j)``, w the best fit to d."""
        seen = jnp.concatenate([self.changes, d[None]])[:, :measured]
        rows = jnp.sum(seen[None] * seen[:SIZE, None], axis=-1)
        for k in range(SIZE):  # normal equations; the pivot is what newer pairs do not contain
            row = jnp.where(rows[k, k] > FILTER, rows[k] / rows[k, k], 0.0)
            rows = jnp.where(np.eye(SIZE)[k, :, None] > 0, row, rows - rows[:, k, None] * row)
        return d - jnp.sum(rows[:, SIZE:] * (self.moves + self.changes), axis=0)

"""Extrapolation of the unknowns from step to step, by backward differences of the order that was best in the last step."""

from typing import Any, NamedTuple

import jax.numpy as jnp

ORDER = 6
"""Highest order of the polynomials."""


class Differences(NamedTuple):
    """values (ORDER + 2, n): backward differences ``d_0 = x_n``, ``d_(j+1) = d_j(x_n) - d_j(x_(n-1))``.

    The polynomial of order k through the last k + 1 values goes on with ``d_0 + ... + d_k``, and d_(k+1) is by how much that
    of the step before missed x_n. Few or rough steps ask for a low order, smooth ones for a high one.
    """

    values: Any

    @classmethod
    def constant(cls, x) -> "Differences":
        """A past in which nothing changed."""
        return cls(jnp.zeros((ORDER + 2, x.size)).at[0].set(x))

    def next(self, measured: int):
        """Where the values go on, by the order that missed the first `measured` entries of the last step least."""
        missed = jnp.max(jnp.abs(self.values[1:, :measured]), axis=1, initial=0.0)
        taken = jnp.arange(ORDER + 2) <= jnp.argmin(jnp.where(jnp.isfinite(missed), missed, jnp.inf))
        return jnp.sum(jnp.where(taken[:, None], self.values, 0.0), axis=0)

    def add(self, x) -> "Differences":
        """With one more step."""
        rows = [x]
        for before in self.values[:-1]:
            rows.append(rows[-1] - before)
        return Differences(jnp.stack(rows))

"""Where slow unknowns go on from step to step."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vmri_jax.kernels import SLOW_ORDER, matmul

FADING = 0.84
"""Factor by which a miss counts less with every step. Nearer to one, the order follows slowly; smaller, one lucky step decides."""


class PolynomialPredictor(NamedTuple):
    """Backward differences ``d_0 = x_n``, ``d_(j+1) = d_j(x_n) - d_j(x_(n-1))``.

    The polynomial of order k through the last k + 1 values goes on with ``d_0 + ... + d_k``, and d_(k+1) is by how much that
    of the step before missed x_n. Few or rough steps ask for a low order, smooth ones for a high one.

    misses: the worst miss of every order in the steps before, fading: one lucky step is not to decide.
    """

    differences: Float[Array, "SLOW_ORDER+2 n"]
    misses: Float[Array, "SLOW_ORDER+1"]

    @classmethod
    def constant(cls, x) -> "PolynomialPredictor":
        """A past in which nothing changed."""
        return cls(jnp.zeros((SLOW_ORDER + 2, x.size)).at[0].set(x), jnp.zeros(SLOW_ORDER + 1))

    def next(self, measured: int):
        """Where the values go on, by the lowest order that has missed the first `measured` entries least."""
        missed, orders = self._missed(measured), jnp.arange(SLOW_ORDER + 1)
        best = jnp.min(jnp.where(missed <= jnp.min(missed), orders, SLOW_ORDER))
        taken = jnp.arange(SLOW_ORDER + 2) <= best
        return jnp.sum(jnp.where(taken[:, None], self.differences, 0.0), axis=0)

    def add(self, x, measured: int) -> "PolynomialPredictor":
        """With one more step."""
        sums = matmul(np.tri(SLOW_ORDER + 1), self.differences[:-1])
        differences = jnp.concatenate([x[None], x - sums])
        missed = self._missed(measured)
        return PolynomialPredictor(differences, jnp.where(jnp.isfinite(missed), FADING * missed, 0.0))

    def _missed(self, measured: int):
        """(SLOW_ORDER + 1,) by how much each order has missed, infinite where a step had failed."""
        misses = jnp.abs(self.differences[1:, :measured])
        misses = jnp.where(misses < jnp.inf, misses, jnp.inf)
        return jnp.maximum(jnp.max(misses, axis=1, initial=0.0), self.misses)

"""Prediction of the unknowns of a slow path, or of a single interval, from the steps before."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vmri_jax.kernels import SLOW_ORDER, matmul

FADING = 0.84
"""Factor per step by which the weight of an old prediction error decreases. With a larger factor the order adapts
slowly; with a smaller one a single accurate prediction decides on it."""


class PolynomialPredictor(NamedTuple):
    """Backward differences of the unknowns x_n of step n, ``d_0^n = x_n``, ``d_(j+1)^n = d_j^n - d_j^(n-1)``.

    The polynomial of degree k through the last k + 1 values extrapolates to ``x_(n+1) = d_0 + ... + d_k``; d_(k+1) is
    the error of this prediction for x_n. Few or rough steps need a low order, smooth motion a high one.

    is_empty: whether there is no step yet; the values are then zero.
    misses: largest prediction error of every order so far, with a weight that decreases by `FADING` per step.
    """

    is_empty: Bool[Array, ""]
    differences: Float[Array, "SLOW_ORDER+2 n"]
    misses: Float[Array, "SLOW_ORDER+1"]

    @classmethod
    def empty(cls, size: int) -> "PolynomialPredictor":
        """The predictor of `size` unknowns before the first step."""
        return cls(jnp.asarray(True), jnp.zeros((SLOW_ORDER + 2, size)), jnp.zeros(SLOW_ORDER + 1))

    def next(self, measured: int, guess):
        """The predicted values, by the lowest order with the least error in the first `measured` entries; the guess
        before the first step."""
        missed, orders = self._missed(measured), jnp.arange(SLOW_ORDER + 1)
        best = jnp.min(jnp.where(missed <= jnp.min(missed), orders, SLOW_ORDER))
        taken = jnp.arange(SLOW_ORDER + 2) <= best
        return jnp.where(self.is_empty, guess, jnp.sum(jnp.where(taken[:, None], self.differences, 0.0), axis=0))

    def add(self, x, measured: int) -> "PolynomialPredictor":
        """The predictor after one more step with the values x; before the first step they count as constant."""
        # d_(j+1) = x_n - (d_0 + ... + d_j)(x_(n-1))
        sums = matmul(np.tri(SLOW_ORDER + 1), self.differences[:-1])
        differences = jnp.concatenate([x[None], jnp.where(self.is_empty, 0.0, x - sums)])
        missed = self._missed(measured)
        return PolynomialPredictor(
            jnp.asarray(False), differences, jnp.where(jnp.isfinite(missed), FADING * missed, 0.0)
        )

    def _missed(self, measured: int):
        """(SLOW_ORDER + 1,) weighted errors of every order, infinite after a failed step."""
        misses = jnp.abs(self.differences[1:, :measured])
        misses = jnp.where(misses < jnp.inf, misses, jnp.inf)
        return jnp.maximum(jnp.max(misses, axis=1, initial=0.0), self.misses)

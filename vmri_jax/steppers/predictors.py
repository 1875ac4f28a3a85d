"""Where unknowns go on: the slow ones from step to step, the fast ones from micro interval to micro interval."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vmri_jax.kernels import FAST_ORDER, SLOW_ORDER, matmul

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


class Parabola(NamedTuple):
    """Unknowns of the micro intervals one after the other; they go on as the parabola through the last three does.

    Kicks at the macro nodes, and the constraint force that two macro steps share, let the first interval of every macro step
    stand out from its neighbours.

    last: of the last three intervals, the last one first, without the jump.
    jump: by how much the first interval of a macro step stands out.
    """

    last: Float[Array, "3 k"]
    jump: Float[Array, "k"]

    @classmethod
    def constant(cls, x) -> "Parabola":
        """A past in which nothing changed."""
        return cls(jnp.stack([x, x, x]), jnp.zeros_like(x))

    def next(self, m):
        """The value that is expected in interval m of a macro step."""
        if FAST_ORDER == 0:
            return self.last[0]
        return 3 * (self.last[0] - self.last[1]) + self.last[2] + jnp.where(m == 0, self.jump, 0.0)

    def add(self, m, x) -> "Parabola":
        """With the value of interval m."""
        x = x - jnp.where(m == 0, self.jump, 0.0)
        return self._replace(last=jnp.concatenate([x[None], self.last[:2]]))

    def after_step(self, x) -> "Parabola":
        """With the values (num_micro, k) of a macro step."""
        after = self
        if len(x) > 1 and FAST_ORDER:
            after = self._replace(jump=x[0] - (self.last[0] + x[1]) / 2)
        for m in range(max(len(x) - 3, 0), len(x)):
            after = after.add(m, x[m])
        return after

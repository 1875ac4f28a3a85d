"""Secant corrections of an approximate Newton update: Broyden's method with a short memory.

An iteration ``z <- z + d, d = -B R(z)`` with a cheap matrix B converges linearly. The update d' after a step s shows what B lacks in the
direction of s. Broyden's rank-one correction takes it in, ``B <- (1 + c s^T / |s|^2) B`` with ``c = d' / (1 - s . d' / |s|^2)``, and the
corrected next step is c. The last corrections are kept, also from one macro step to the next, since the equations change slowly
(C. T. Kelley, *Iterative Methods for Linear and Nonlinear Equations*, SIAM 1995, chapter 7).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vmri_jax.kernels import SECANTS

LARGEST_RATIO = 0.5
"""Largest ``|d'| / |s|`` from which the iteration learns. A larger value takes in updates that are mostly curvature or round-off."""


class Secants(NamedTuple):
    """The last corrections, `SECANTS` of them, oldest first.

    steps: ``s / |s|^2``, zeros for a correction that is not there.
    changes: c.
    """

    steps: Float[Array, "SECANTS n"]
    changes: Float[Array, "SECANTS m"]

    @classmethod
    def none(cls, measured: int, size: int) -> "Secants":
        """No corrections, of updates (size,) whose first `measured` entries have one unit, in which products are taken."""
        return cls(jnp.zeros((SECANTS, measured)), jnp.zeros((SECANTS, size)))

    def corrected(self, d):
        """An update by the cheap matrix, with all corrections."""
        for step, change in zip(self.steps, self.changes, strict=True):
            d += jnp.sum(step * d[: step.size]) * change
        return d

    def after(self, s, d, is_wanted) -> tuple["Secants", Array]:
        """The corrections after one more step s and the update d by the cheap matrix that follows it, and this update with them.

        Args:
            is_wanted: whether the iteration goes on; the last updates are round-off.
        """
        d, measured = self.corrected(d), self.steps.shape[1]
        squared = jnp.sum(s[:measured] ** 2)
        step = s[:measured] / jnp.where(squared > 0, squared, 1.0)
        change = d / (1 - jnp.sum(step * d[:measured]))
        learns = is_wanted & (jnp.sum(d[:measured] ** 2) < LARGEST_RATIO**2 * squared)
        new = Secants(*(jnp.concatenate([old[1:], a[None]]) for old, a in zip(self, (step, change), strict=True)))
        return jax.tree.map(lambda a, b: jnp.where(learns, a, b), (new, change), (self, d))

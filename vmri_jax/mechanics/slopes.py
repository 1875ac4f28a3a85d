"""The rows of constraints at a configuration to first order, and the unit of each row.

Every number is judged in its own unit. A row ``g_i(t, q)`` of the constraints counts as kept below

    allowed_i = tolerance size_i + ROUNDING eps (terms_i + reach_i)
    size_i = max(terms_i, min(|G_i|^2 / |hess g_i|, reach_i))        reach_i = sum_j |dg_i/dq_j| / w_j largest

with the size terms_i of the terms that cancel in it, ``|d| + L`` of ``|d| - L`` (`sizes_of_terms`), its change over its
radius of curvature, and the largest position ``max_k |w_k q_k|`` or, if that is larger, the displacement that the
constraints take from a step: at the origin the round-off of this displacement is all that there is. An implied row is
of order one, and so is its rounding: of the row across the plane of a linkage all terms are round-off. The weights w,
square roots of the masses, give all coordinates one unit: lengths of gradients and reach_i, the change of a row over
the largest position, which bounds its round-off, are taken with them.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vmri_jax.kernels import matvec, max_abs
from vmri_jax.mechanics.arrays import Numbers, library, split_at
from vmri_jax.mechanics.structure import sizes_of_terms
from vmri_jax.mechanics.system import System

ROUNDING = 100
"""Value of a row in units of its rounding, ``eps (terms + reach)``, that always counts as zero: a row has tens of
operations. A smaller value refuses starts far from the origin, a larger one lets short rods there have the wrong
length."""


class ScaledRows(NamedTuple):
    """The rows at a configuration: those that are solved for, then the implied ones; see the top of this module.

    values: g.
    sizes: size_i.
    rounding: ``terms_i + reach_i``.
    gradients: ``dg_i/dq_j / w_j`` with respect to (q_s, q_f).
    """

    values: Float[Numbers, "k"]
    sizes: Float[Numbers, "k"]
    rounding: Float[Numbers, "k"]
    gradients: Float[Numbers, "k n"]

    def allowed(self, tolerance, solved: int):
        """(k,) the values up to which rows count as kept; those after the `solved` ones are implied."""
        is_implied = np.arange(self.values.shape[-1]) >= solved
        return tolerance * self.sizes + ROUNDING * np.finfo(float).eps * (self.rounding + is_implied)


class Slopes(NamedTuple):
    """The rows at a configuration to first order, those that are solved for first.

    q: (q_s, q_f).
    values, jacobian, rates: g, G and dg/dt.
    terms: terms_i, see the top of this module.
    bent: the derivative of G along a direction (n,).
    """

    q: Float[Numbers, "n"]
    values: Float[Numbers, "k"]
    jacobian: Float[Numbers, "k n"]
    rates: Float[Numbers, "k"]
    terms: Float[Numbers, "k"]
    bent: Callable

    @classmethod
    def of(cls, function, q) -> "Slopes":
        """The slopes of a function of q (n,) that does not depend on time."""

        def gradients_and_values(q):
            values, pull = jax.vjp(function, q)
            return jax.vmap(pull)(jnp.eye(values.size))[0], values

        jacobian, bent, values = jax.linearize(gradients_and_values, q, has_aux=True)
        return cls(q, values, jacobian, jnp.zeros_like(values), sizes_of_terms(function, q), bent)

    def residual(self, v):
        """Largest ``|g|`` and largest ``|G v + dg/dt|``, shape (2,), for velocities (n,)."""
        return jnp.stack([max_abs(self.values), max_abs(matvec(self.jacobian, v) + self.rates)])

    def scaled(self, weights, taken: Any = 0.0) -> ScaledRows:
        """The `ScaledRows`, for weights w (n,) of the coordinates; `taken` is the displacement that the constraints
        take from a step, times weights."""
        direction = np.random.default_rng(0).normal(size=self.q.size) / weights
        gradients, bends = self.jacobian / weights, self.bent(direction) / weights
        largest = jnp.maximum(max_abs(weights * self.q), max_abs(taken))
        reach = jnp.sum(jnp.abs(gradients), axis=1) * largest
        # |hess g e| of a random direction e for the norm of the Hessian
        squared, bend = jnp.sum(gradients**2, axis=1), jnp.linalg.norm(bends, axis=1)
        radius = jnp.where(bend > 0, squared / jnp.where(bend > 0, bend, 1.0), 0.0)
        sizes = jnp.maximum(self.terms, jnp.minimum(radius, reach))
        return ScaledRows(self.values, sizes, self.terms + reach, gradients)


def slopes_at(system: System, t, q_s, q_f) -> Slopes:
    """The `Slopes` of a system."""
    n_s, q = q_s.shape[0], jnp.concatenate([q_s, q_f])

    def rows(t, q):
        return jnp.concatenate([f(t, *split_at(q, n_s)) for f in (system.constraints, system.g_implied)])

    slopes = Slopes.of(partial(rows, t), q)
    if any(term.moves for term in system.terms):
        return slopes._replace(rates=jax.jvp(lambda t: rows(t, q), (t,), (jnp.ones_like(t),))[1])
    return slopes


def weights_of(masses):
    """(n,) the weights w: square roots of masses, 1 for a coordinate without a mass."""
    xp = library(masses)
    return xp.sqrt(xp.where(masses > 0, masses, 1.0))

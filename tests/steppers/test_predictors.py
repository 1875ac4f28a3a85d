"""Extrapolation of unknowns, and minimal residuals: pure mathematics, on numbers whose answer is known."""

import jax
import jax.numpy as jnp
import numpy as np

from tests.support import largest_difference
from vmri_jax.steppers.predictors import PolynomialPredictor
from vmri_jax.steppers.slow_equations import LEFT_OVER, minimal_residuals


def test_extrapolation_takes_the_order_that_was_best():
    n = np.arange(12.0)
    smooth, rough = 2 - n + 0.5 * n**3, np.random.default_rng(0).normal(size=12)
    for values, error in ((smooth, 1e-10), (rough, 5.0)):
        past = PolynomialPredictor.empty(1)
        for x in values[:-1]:
            past = past.add(jnp.asarray([x]), 1)
        assert abs(past.next(1, guess=jnp.nan)[0] - values[-1]) < error
    rough, past, missed = np.random.default_rng(0).normal(size=200), PolynomialPredictor.empty(1), []
    assert past.next(1, guess=3.0)[0] == 3.0
    next_value, add = jax.jit(lambda past: past.next(1, guess=0.0)), jax.jit(lambda past, x: past.add(x, 1))
    for x in rough:
        missed.append(abs(float(next_value(past)[0]) - x))
        past = add(past, jnp.asarray([x]))
    assert np.mean(missed) < 1.5  # measured 1.2; 2.3 if the last step alone decided on the order
    gap = past.add(jnp.asarray([jnp.nan]), 1).add(jnp.asarray([7.0]), 1)
    assert gap.next(1, guess=jnp.nan)[0] == 7.0  # a step that failed leaves no trace in the ones after


def test_minimal_residuals_solve_a_linear_problem():
    """Not symmetric, and close to one."""
    matrix = jnp.eye(5) + 0.03 * jnp.asarray(np.random.default_rng(0).normal(size=(5, 5)))
    b = jnp.arange(1.0, 6.0)
    x = minimal_residuals(lambda x: matrix @ x, b)
    assert largest_difference(matrix @ x, b) < 5 * LEFT_OVER  # of the largest entry of b
    assert np.array_equal(minimal_residuals(lambda x: matrix @ x, 0 * b), 0 * b)

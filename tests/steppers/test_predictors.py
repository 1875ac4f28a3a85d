"""Extrapolation of unknowns, and minimal residuals: pure mathematics, on numbers whose answer is known."""

import jax
import jax.numpy as jnp
import numpy as np

from tests.support import largest_difference
from vmri_jax.steppers.predictors import PolynomialPredictor
from vmri_jax.steppers.slow_equations import LEFT_OVER, minimal_residuals


@jax.jit
def following(past, guess):
    """The next value of a single unknown."""
    return past.next(1, guess=guess)[0]


@jax.jit
def with_value(past, x):
    return past.add(jnp.reshape(x, (1,)), 1)


def test_extrapolation_takes_the_order_that_was_best():
    n, empty = np.arange(12.0), PolynomialPredictor.empty(1)
    smooth, rough = 2 - n + 0.5 * n**3, np.random.default_rng(0).normal(size=12)
    for values, error in ((smooth, 1e-10), (rough, 5.0)):
        past = empty
        for x in values[:-1]:
            past = with_value(past, x)
        assert abs(float(following(past, np.nan)) - values[-1]) < error
    rough, past, missed = np.random.default_rng(0).normal(size=200), empty, []
    assert following(past, 3.0) == 3.0
    for x in rough:
        missed.append(abs(float(following(past, 0.0)) - x))
        past = with_value(past, x)
    assert np.mean(missed) < 1.5  # measured 1.2; 2.3 if the last step alone decided on the order
    gap = with_value(with_value(past, np.nan), 7.0)
    assert following(gap, np.nan) == 7.0  # a step that failed leaves no trace in the ones after


def test_minimal_residuals_solve_a_linear_problem():
    """Not symmetric, and close to one."""
    matrix, b = np.eye(5) + 0.03 * np.random.default_rng(0).normal(size=(5, 5)), np.arange(1.0, 6.0)
    solution = jax.jit(lambda b: minimal_residuals(lambda x: matrix @ x, b))
    assert largest_difference(matrix @ np.asarray(solution(b)), b) < 5 * LEFT_OVER  # of the largest entry of b
    assert np.array_equal(solution(0 * b), 0 * b)

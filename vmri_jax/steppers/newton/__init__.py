"""Newton's iteration for the equations of a macro step: methods, linear solvers, derivative."""

from vmri_jax.steppers.newton import drift, march
from vmri_jax.steppers.newton.collocation import is_collocation
from vmri_jax.steppers.newton.interval import IntervalMatrix, interval_matrix, is_constant
from vmri_jax.steppers.newton.iteration import Newton, is_solved, solve

__all__ = [
    "IntervalMatrix",
    "Newton",
    "drift",
    "interval_matrix",
    "is_collocation",
    "is_constant",
    "is_solved",
    "march",
    "solve",
]

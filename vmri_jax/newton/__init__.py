"""Newton's iteration for the equations of a macro step: methods, linear solvers, derivative."""

from vmri_jax.newton.interval import interval_matrix, is_constant
from vmri_jax.newton.iteration import Newton, solve
from vmri_jax.newton.march import Warm

__all__ = ["Newton", "Warm", "interval_matrix", "is_constant", "solve"]

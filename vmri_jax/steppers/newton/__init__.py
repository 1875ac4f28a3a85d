"""Newton's iteration over all unknowns of a macro step: options, linear solvers, derivative of the solution."""

from vmri_jax.steppers.newton.options import Newton

__all__ = ["Newton"]

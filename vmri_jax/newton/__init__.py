"""Newton's iteration for the equations of a macro step, its linear solvers and its derivative."""

from vmri_jax.newton.iteration import Newton, relative_residual, solve

__all__ = ["Newton", "relative_residual", "solve"]

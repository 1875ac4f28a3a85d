"""Optimal control on macro and micro grids."""

from vmri_jax.control.minimize import minimize
from vmri_jax.control.optimum import Optimum

__all__ = ["Optimum", "minimize"]

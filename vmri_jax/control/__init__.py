"""Optimal control on macro and micro grids."""

from vmri_jax.control.minimize import Optimum, minimize

__all__ = ["Optimum", "minimize"]

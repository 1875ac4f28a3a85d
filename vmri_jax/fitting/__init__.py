"""Identification of parameters from measured motion: `vmri_jax.fit`."""

from vmri_jax.fitting.fit import fit
from vmri_jax.fitting.given import Measured, Unknown
from vmri_jax.fitting.result import Bootstrap, Fit

__all__ = ["Bootstrap", "Fit", "Measured", "Unknown", "fit"]

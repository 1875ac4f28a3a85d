"""Identification of parameters from measured motion: `vmri_jax.fit`."""

from vmri_jax.fitting.fit import fit
from vmri_jax.fitting.measured import Measured
from vmri_jax.fitting.result import Bootstrap, Fit
from vmri_jax.fitting.unknowns import Unknown

__all__ = ["Bootstrap", "Fit", "Measured", "Unknown", "fit"]

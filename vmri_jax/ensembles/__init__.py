"""Ensembles: many runs of one system, from one core to a cluster, into a store on disk."""

from vmri_jax.ensembles.design import Axis, Draw, Draws, Product, Table
from vmri_jax.ensembles.quantities import QUANTITIES
from vmri_jax.ensembles.reading import open_ensemble
from vmri_jax.ensembles.run import Ensemble, EnsembleError, ensemble

__all__ = [
    "QUANTITIES",
    "Axis",
    "Draw",
    "Draws",
    "Ensemble",
    "EnsembleError",
    "Product",
    "Table",
    "ensemble",
    "open_ensemble",
]

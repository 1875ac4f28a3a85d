"""Small dense algebra, and what steppers remember: the one place for what is written for speed alone.

Two modules have the same names: `plain`, what a reader expects, and `cpu`, the tuned form. The environment variable
VMRI_KERNELS (``plain`` or ``cpu``, the default) chooses one when the package is imported. `band` inverts matrices with many zeros.
`inverse_in_loop` is that of `cpu` with both.
"""

import os

from vmri_jax.kernels import cpu, plain
from vmri_jax.kernels.band import Band, BandInverse, Full, FullInverse, Sparsity, sparsity
from vmri_jax.kernels.cpu import inverse_in_loop
from vmri_jax.kernels.saddle import REGULARIZATION, regularized, saddle

CHOICES = {"plain": plain, "cpu": cpu}

_name = os.environ.get("VMRI_KERNELS", "cpu")
if _name not in CHOICES:
    raise ValueError(f"VMRI_KERNELS is {_name!r}; it must be one of {', '.join(CHOICES)}.")
_chosen = CHOICES[_name]

inverse = _chosen.inverse
matmul = _chosen.matmul
matvec = _chosen.matvec
max_abs = _chosen.max_abs
solve = _chosen.solve

COLLOCATES = _chosen.COLLOCATES
CONTRACTION = _chosen.CONTRACTION
DEFERS_PROJECTION = _chosen.DEFERS_PROJECTION
DIAGONAL_MATRICES = _chosen.DIAGONAL_MATRICES
DRIFTS = _chosen.DRIFTS
LARGEST_RENEWED = _chosen.LARGEST_RENEWED
LINEARISES_FORCES = _chosen.LINEARISES_FORCES
SLOW_ORDER = _chosen.SLOW_ORDER

__all__ = [
    "COLLOCATES",
    "CONTRACTION",
    "DEFERS_PROJECTION",
    "DIAGONAL_MATRICES",
    "DRIFTS",
    "LARGEST_RENEWED",
    "LINEARISES_FORCES",
    "REGULARIZATION",
    "SLOW_ORDER",
    "Band",
    "BandInverse",
    "Full",
    "FullInverse",
    "Sparsity",
    "inverse",
    "inverse_in_loop",
    "matmul",
    "matvec",
    "max_abs",
    "regularized",
    "saddle",
    "solve",
    "sparsity",
]

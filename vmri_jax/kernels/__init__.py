"""Small dense algebra and settings of the steppers: the only place for code that is written for speed alone.

Two modules define the same functions and constants: `plain`, the textbook form, and `cpu`, the tuned form. The environment variable VMRI_KERNELS (``plain`` or
``cpu``, the default) chooses one when the package is imported, see `chosen`. `band` inverts matrices with many zeros. `inverse_in_loop`
comes from `cpu` in both cases.
"""

from vmri_jax.kernels.band import Band, BandInverse, Full, FullInverse, Sparsity, sparsity
from vmri_jax.kernels.chosen import (
    COLLOCATES,
    CONTRACTION,
    DEFERS_PROJECTION,
    DIAGONAL_MATRICES,
    DRIFTS,
    LARGEST_RENEWED,
    LINEARISES_FORCES,
    SLOW_ORDER,
    inverse,
    matmul,
    matvec,
    max_abs,
    solve,
)
from vmri_jax.kernels.cpu import inverse_in_loop
from vmri_jax.kernels.saddle import REGULARIZATION, regularized, saddle

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

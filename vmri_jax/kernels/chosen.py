"""The functions and constants of `cpu`, or of `plain` if the environment variable VMRI_KERNELS says so."""

import os

from vmri_jax.kernels import cpu, plain

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

"""Small dense algebra and settings of the steppers: the only place for code that is written for speed alone.

Two modules define the same functions and constants: `plain`, the textbook form, and `cpu`, the tuned form. The
environment variable VMRI_KERNELS (``plain`` or ``cpu``, the default) chooses one when the package is imported. `band`
inverts matrices with many zeros.
"""

import os

from vmri_jax.kernels import cpu, plain
from vmri_jax.refusals import Refused

CHOICES = {"plain": plain, "cpu": cpu}

_name = os.environ.get("VMRI_KERNELS", "cpu")
if _name not in CHOICES:
    raise Refused(f"VMRI_KERNELS is {_name!r}; it must be one of {', '.join(CHOICES)}.")
_chosen = CHOICES[_name]

inverse = _chosen.inverse
matmul = _chosen.matmul
matvec = _chosen.matvec
max_abs = _chosen.max_abs
solve = _chosen.solve

COLLOCATES = _chosen.COLLOCATES
CONTRACTION = _chosen.CONTRACTION
DIAGONAL_MATRICES = _chosen.DIAGONAL_MATRICES
DRIFTS = _chosen.DRIFTS
FEWEST_IN_PARTS = _chosen.FEWEST_IN_PARTS
LANES_IN_TURN = _chosen.LANES_IN_TURN
LARGEST_RENEWED = _chosen.LARGEST_RENEWED
LINEARISES_FORCES = _chosen.LINEARISES_FORCES
SLOW_ORDER = _chosen.SLOW_ORDER

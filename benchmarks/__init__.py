"""Measurements of time and memory; `python -m benchmarks --help`."""

import os

os.environ.setdefault(
    "OPENBLAS_NUM_THREADS", "1"
)  # before NumPy reads it; matrices here are small: threads only make times scatter

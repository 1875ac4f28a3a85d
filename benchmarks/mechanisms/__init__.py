"""Mechanisms by directors, in joint coordinates and by other integrators, at equal error."""

from benchmarks.mechanisms.compare import run, sizes

__all__ = ["run", "sizes"]

"""Our integrators and those that people use instead, each in a file of its own, on the same problems."""

from benchmarks.peers.compare import COLUMNS, run, sizes

__all__ = ["COLUMNS", "run", "sizes"]

"""Our integrators and those that people use instead, each in a file of its own, on the same problems."""

from benchmarks.peers.compare import COLUMNS, programs_of, run, sizes

__all__ = ["COLUMNS", "programs_of", "run", "sizes"]

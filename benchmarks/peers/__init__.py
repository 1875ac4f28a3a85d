"""Our integrators and those that people use instead, each in a file of its own, on the same problems."""

from benchmarks.peers.compare import run, sizes

__all__ = ["run", "sizes"]

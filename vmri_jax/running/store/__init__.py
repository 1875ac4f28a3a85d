"""Trajectories on disk: long runs written chunk by chunk, which can be resumed after their process was killed."""

from vmri_jax.running.store.stored import StoredTrajectory
from vmri_jax.running.store.stream import stream

__all__ = ["StoredTrajectory", "stream"]

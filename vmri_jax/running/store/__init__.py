"""Trajectories on disk: long runs written chunk by chunk, that survive a kill and go on where they were."""

from vmri_jax.running.store.stored import StoredTrajectory
from vmri_jax.running.store.stream import stream

__all__ = ["StoredTrajectory", "stream"]

"""Trajectories on disk: long runs written chunk by chunk, which can be resumed after their process was killed."""

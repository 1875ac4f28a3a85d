"""Check before a run that its trajectory fits into the free memory."""

import psutil

from vmri_jax.mechanics.state import State
from vmri_jax.running.observables import Observables
from vmri_jax.running.saved import numbers_per_node

BYTES_PER_NUMBER = 8
UNCHECKED_BYTES = 100e6
"""Bytes of a trajectory up to which free memory is not looked up: the look-up takes some ten microseconds, as long as a short run. With a
larger value more runs may fill a small machine."""


def check_memory(caller: str, state: State, num_micro: int, num_saves: int, save_micro: bool, lanes: int = 1) -> None:
    """Refuse a run whose trajectory would not fit into the free memory.

    Args:
        caller: the function that was called, for the message.
        state: start of one lane.
        num_micro: micro nodes of a saved node, if they are kept.
        num_saves: saved intervals.
        save_micro: whether micro nodes are kept.
        lanes: runs whose trajectories are kept together.

    Raises:
        ValueError: the trajectory is larger than the free memory.
    """
    numbers = numbers_per_node(state, num_micro if save_micro else 0) + len(Observables._fields)
    needed = BYTES_PER_NUMBER * numbers * (num_saves + 1) * lanes
    if needed < UNCHECKED_BYTES:
        return
    free = psutil.virtual_memory().available
    if needed > free:
        raise ValueError(
            f"{caller}: {num_saves + 1} saved nodes{f' of {lanes} runs' if lanes > 1 else ''} would take {needed / 1e9:.3g} GB, and "
            f"{free / 1e9:.3g} GB of memory are free. Save fewer of them (save=...), or write them to disk as they come "
            "(vmri_jax.stream)."
        )

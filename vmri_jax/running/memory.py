"""Whether a result fits into memory, asked before a run starts."""

import psutil

from vmri_jax.mechanics.state import State

NUMBER = 8
"""Bytes of a number."""
ALWAYS_FITS = 100e6
"""Bytes that are not asked about: the question takes some ten microseconds."""
ALONGSIDE = 7
"""Numbers that are kept of a saved node besides positions and momenta: time, energy, constraints, what the solver did."""


def check_memory(what: str, state: State, num_micro: int, num_saves: int, save_micro: bool, lanes: int = 1) -> None:
    """Refuse a run whose trajectory would not fit into the memory that is free.

    Args:
        what: the function that was called, for the message.
        state: start of one lane.
        num_micro: micro nodes of a saved node, if they are kept.
        num_saves: saved nodes.
        save_micro: whether micro nodes are kept.
        lanes: runs whose results are kept together.

    Raises:
        ValueError: what it would take, what there is, and what to do.
    """
    numbers = 2 * (state.q_s.size + state.q_f.size) + ALONGSIDE
    if save_micro:
        numbers += num_micro * (state.q_f.size + 1)
    needed = NUMBER * numbers * (num_saves + 1) * lanes
    if needed < ALWAYS_FITS:
        return
    free = psutil.virtual_memory().available
    if needed > free:
        raise ValueError(
            f"{what}: {num_saves} saved nodes{f' of {lanes} runs' if lanes > 1 else ''} would take {needed / 1e9:.3g} GB, and "
            f"{free / 1e9:.3g} GB of memory are free. Save fewer of them (save_every=...), or write them to disk as they come "
            "(vmri_jax.stream)."
        )

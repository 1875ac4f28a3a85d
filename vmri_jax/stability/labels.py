"""Check for swapped slow and fast variables: the variables that carry the fastest vibration should be the fast ones."""

import numpy as np

from vmri_jax.mechanics.names import Names
from vmri_jax.stability.linear import SmallMotions, small_motions

SWAPPED_RATIO = 2.0
"""Ratio of the highest frequency of slow variables to the highest frequency of fast variables, above which their labels are probably swapped;
a larger value overlooks more swapped labels."""


def swapped(motions: SmallMotions, names: Names | None = None) -> tuple[str, float] | None:
    """Advice if slow variables vibrate faster than fast ones, and the ratio of their highest frequencies; else None."""
    frequencies, _ = motions.modes
    n_s, n_f, shares = motions.rest.q_s.size, motions.rest.q_f.size, motions.kinetic_shares
    slow = shares[:n_s].sum(axis=0) > 0.5
    slow_highest, fast_highest = frequencies[slow].max(initial=0.0), frequencies[~slow].max(initial=0.0)
    if not n_f or slow_highest <= SWAPPED_RATIO * fast_highest or slow_highest == 0:
        return None
    carried = shares[:n_s, frequencies > slow_highest / SWAPPED_RATIO].sum(axis=1)
    labels = (names or Names()).of_coordinates(n_s, n_f).slow_coordinates
    sentence = (
        f"The fastest vibration, of frequency {slow_highest:.4g}, is one of the slow variables "
        f"{', '.join(labels[i] for i in np.flatnonzero(carried > 0.1))}; vibrations of the fast variables reach {fast_highest:.4g}. "
        "Swap the labels: make these variables fast and put their energy into fast_potential, and the soft ones slow."
    )
    return sentence, float(slow_highest / fast_highest) if fast_highest else np.inf


def swapped_at_start(trajectory) -> str:
    """The sentence of `swapped` about the first node of a failed run; empty if its labels are right or its system is not known."""
    if not trajectory.states.q_s.shape[-1] or not trajectory.states.q_f.shape[-1]:
        return ""  # nothing to swap: small motions of all coordinates would take seconds to compile
    try:
        advice = swapped(small_motions(trajectory.origin.system(), trajectory[0]), trajectory.names)
    except (ValueError, TypeError, IndexError):  # no expansion at the start: the error of the run says more about it
        return ""
    return advice[0] if advice else ""

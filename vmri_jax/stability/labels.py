"""Are slow and fast variables swapped? The variables that carry the fastest vibration should be the fast ones."""

import numpy as np

from vmri_jax.mechanics.names import Names
from vmri_jax.stability.linear import SmallMotions, small_motions

FASTER = 2.0
"""Ratio of the fastest frequency of slow variables to that of fast ones above which the two are probably swapped."""


def swapped(motions: SmallMotions, names: Names | None = None) -> tuple[str, float] | None:
    """What to do about slow variables that vibrate faster than the fast ones, and how much faster; None if they do not.

    Args:
        motions: the small motions of a system about a state.
        names: of its coordinates, where they are known.
    """
    frequencies, modes = motions.modes
    n_s, n_f, d = motions.rest.q_s.size, motions.rest.q_f.size, len(frequencies)
    shares = (motions.shapes @ modes) * (motions.embed[n_s + n_f :, d:] @ modes)  # of each coordinate in each mode
    slow = shares[:n_s].sum(axis=0) > 0.5
    fastest, others = frequencies[slow].max(initial=0.0), frequencies[~slow].max(initial=0.0)
    if not n_f or fastest <= FASTER * others or fastest == 0:
        return None
    carried = shares[:n_s, frequencies > fastest / FASTER].sum(axis=1)
    labels = (names or Names()).of_coordinates(n_s, n_f).slow_coordinates
    sentence = (
        f"The fastest vibration, of frequency {fastest:.4g}, is one of the slow variables "
        f"{', '.join(labels[i] for i in np.flatnonzero(carried > 0.1))}; those of the fast variables reach {others:.4g}. "
        "Swap the labels: make these variables fast and put their energy into fast_potential, and the soft ones slow."
    )
    return sentence, float(fastest / others) if others else np.inf


def swapped_at_start(trajectory) -> str:
    """The sentence of `swapped` about the first node of a run that failed; empty where there is nothing to say.

    Args:
        trajectory: it knows its system.
    """
    if not trajectory.states.q_s.shape[-1] or not trajectory.states.q_f.shape[-1]:
        return ""  # nothing to swap: small motions of all coordinates would take seconds to compile
    try:
        found = swapped(small_motions(trajectory.origin.system(), trajectory[0]), trajectory.names)
    except (ValueError, TypeError, IndexError):  # nothing to expand: there is a better message about that
        return ""
    return found[0] if found else ""

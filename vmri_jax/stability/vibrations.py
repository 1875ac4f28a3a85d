"""The vibrations of a system about a state, and the coordinates that carry them, to choose macro and micro steps that resolve them.

The linearised system is ``M x'' = -K x`` on the tangent space of the constraints. In a vibration u with ``K u = omega^2 M u`` and
``u^T M u = 1``, coordinate i has the part ``u_i (M u)_i`` of the kinetic energy.
"""

from dataclasses import dataclass

import numpy as np

from vmri_jax.mechanics.names import Names
from vmri_jax.mechanics.state import Movable, State, start_of
from vmri_jax.running.origin import names_of
from vmri_jax.schemes.scheme import fully_implicit
from vmri_jax.stability.drive import drive_period, driven_motion
from vmri_jax.stability.linear import SmallMotions, small_motions
from vmri_jax.study.table import Column, ResultTable

ROWS_SHOWN = 12
"""Vibrations in the printed table, the fastest first; a larger number makes it longer than a screen."""
MOST_NAMED = 3
"""Most coordinates that the table names for a vibration; a larger number makes its lines longer."""
LEAST_PART = 0.05
"""Least part of the kinetic energy of a coordinate that is named; a larger value names fewer coordinates."""
SWAPPED_RATIO = 2.0
"""Ratio of the highest frequency of slow variables to the highest frequency of fast variables, above which their labels are probably swapped;
a larger value overlooks more swapped labels."""


@dataclass(frozen=True)
class Vibration:
    """One vibration of the linearised system.

    frequency: angular frequency; zero for a motion that does not vibrate.
    period: ``2 pi / frequency``.
    fast_part: part of its kinetic energy in the fast coordinates.
    parts: part of its kinetic energy in each coordinate by name, the largest first.
    """

    frequency: float
    period: float
    fast_part: float
    parts: dict[str, float]


def _named(vibration: Vibration) -> str:
    named = [f"{name} {part:.0%}" for name, part in vibration.parts.items() if part >= LEAST_PART][:MOST_NAMED]
    return ", ".join(named) or "spread over many"


@dataclass(frozen=True)
class Vibrations(ResultTable):
    """The vibrations about a state, the fastest first.

    rows: all vibrations.
    growth_rate: largest rate r of a motion of the system that grows like ``exp(r t)``; 0 if none grows, or where the linearisation does not tell.
        Under a periodic drive the mean over its first period.
    note: the point of linearisation and the growth in words, where the state is no equilibrium or something grows.
    """

    columns = (
        Column("frequency", lambda row: f"{row.frequency:.5g}", right=True),
        Column("period", lambda row: f"{row.period:.4g}" if row.frequency > 0 else "-", right=True),
        Column("in fast coordinates", lambda row: f"{row.fast_part:.0%}", right=True),
        Column("kinetic energy in", _named),
    )
    rows: tuple[Vibration, ...]
    growth_rate: float
    note: str

    def shown(self) -> tuple[Vibration, ...]:
        """The rows of the printed table, the fastest vibrations."""
        return self.rows[:ROWS_SHOWN]

    @property
    def caption(self) -> str:
        """The number of rows that the table leaves out, and whether the state is unstable."""
        omitted = len(self.rows) - ROWS_SHOWN
        more = f"{omitted} slower ones are in .rows and .to_csv(path). " if omitted > 0 else ""
        return (more + self.note).strip()


def vibrations(system: Movable, state: State | None = None) -> Vibrations:
    """Frequencies of the system linearised at a state, and the coordinates that carry each vibration.

    Args:
        system: a problem, a scene, or a system with a state.
        state: point of linearisation, which constant forces hold at rest; None for the start of the problem.

    Raises:
        TypeError, ValueError: as of `vmri_jax.stability.small_motions`.
    """
    names = names_of(system) or Names()
    system, state = start_of("vibrations", system, state)
    n_s, n_f = state.q_s.size, state.q_f.size
    names = names.of_coordinates(n_s, n_f)
    labels = [*names.slow_coordinates, *names.fast_coordinates]
    motions = small_motions(system, state)
    rows = []
    for frequency, parts in zip(motions.modes[0].tolist(), motions.kinetic_shares.T, strict=True):
        largest = {labels[i]: float(parts[i]) for i in np.argsort(-parts)}
        period = 2 * np.pi / frequency if frequency > 0 else np.inf
        rows.append(Vibration(frequency, period, float(parts[n_s:].sum()), largest))
    rate, note = float(np.real(motions.growing).max(initial=0.0)), ""
    if motions.frozen and (rate or motions.driven):
        rate, note, step = 0.0, motions.frozen, 1 / max(np.abs(motions.rates).max(initial=0.0), 1e-300)
        if (period := drive_period(system, state, step)) is not None:
            motion = driven_motion(system, fully_implicit(1), state, step, period)
            rate, note = float(np.log1p(motion.growth) / period), f"{note.split(' Whether')[0]} {motion}"
    elif rate:
        note = f"Motion about this state grows by itself, like exp({rate:.3g} t)."
    return Vibrations(tuple(rows), rate, note)


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

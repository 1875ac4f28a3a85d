"""The vibrations of a system about a state, and which coordinates carry them: what a macro and a micro step have to resolve.

Of the small motions of the linearised system, ``M x'' = -K x`` on the tangent space of the constraints, with ``K u = omega^2 M u``
and ``u^T M u = 1``: coordinate i has the part ``u_i (M u)_i`` of the kinetic energy of the vibration.
"""

from dataclasses import dataclass

import numpy as np

from vmri_jax.mechanics.names import Names
from vmri_jax.mechanics.state import Movable, State, start_of
from vmri_jax.running.origin import names_of
from vmri_jax.stability.linear import small_motions
from vmri_jax.study.table import Column, ResultTable

ROWS_SHOWN = 12
"""Vibrations in the table, the fastest first."""
NAMED = 3
"""Coordinates that are named for each vibration."""
LEAST_PART = 0.05
"""Part of the kinetic energy below which a coordinate is not named."""


@dataclass(frozen=True)
class Vibration:
    """One vibration of the linearised system.

    frequency: angular, zero for a motion that does not vibrate.
    period: ``2 pi / frequency``.
    fast_part: part of its kinetic energy in the fast coordinates.
    parts: part of its kinetic energy in each coordinate by name, the largest first.
    """

    frequency: float
    period: float
    fast_part: float
    parts: dict[str, float]


def _named(vibration: Vibration) -> str:
    named = [f"{name} {part:.0%}" for name, part in vibration.parts.items() if part >= LEAST_PART][:NAMED]
    return ", ".join(named) or "spread over many"


@dataclass(frozen=True)
class Vibrations(ResultTable):
    """The vibrations about a state, the fastest first.

    growth_rate: of the motion about the state that grows fastest by itself, ``exp(growth_rate t)``; 0 where none does.
    """

    columns = (
        Column("frequency", lambda row: f"{row.frequency:.5g}", right=True),
        Column("period", lambda row: f"{row.period:.4g}" if row.frequency > 0 else "-", right=True),
        Column("in fast coordinates", lambda row: f"{row.fast_part:.0%}", right=True),
        Column("kinetic energy in", _named),
    )
    rows: tuple[Vibration, ...]
    growth_rate: float

    def shown(self) -> tuple[Vibration, ...]:
        """The fastest ones."""
        return self.rows[:ROWS_SHOWN]

    @property
    def caption(self) -> str:
        """How many are left out, and whether the state is unstable."""
        left = len(self.rows) - ROWS_SHOWN
        more = f"{left} slower ones are in .rows and .to_csv(path). " if left > 0 else ""
        grows = (
            f"Motion about this state grows by itself, like exp({self.growth_rate:.3g} t)." if self.growth_rate else ""
        )
        return (more + grows).strip()


def vibrations(system: Movable, state: State | None = None) -> Vibrations:
    """Frequencies of the system linearised at a state, and the coordinates that carry each vibration.

    Args:
        system: a problem, a scene, or a system with a state.
        state: where it is linearised, held there by constant forces; None for the start of the problem.

    Raises:
        TypeError, ValueError: as of `vmri_jax.stability.small_motions`.
    """
    names = names_of(system) or Names()
    system, state = start_of("vibrations", system, state)
    n_s, n_f = state.q_s.size, state.q_f.size
    names = names.of_coordinates(n_s, n_f)
    labels = [*names.slow_coordinates, *names.fast_coordinates]
    motions = small_motions(system, state)
    frequencies, modes = motions.modes
    d = motions.shapes.shape[1]
    energies = (motions.shapes @ modes) * (
        motions.embed[n_s + n_f :, d:] @ modes
    )  # u_i (M u)_i, a column for each vibration
    rows = []
    for frequency, parts in zip(frequencies.tolist(), energies.T, strict=True):
        largest = {labels[i]: float(parts[i]) for i in np.argsort(-parts)}
        period = 2 * np.pi / frequency if frequency > 0 else np.inf
        rows.append(Vibration(frequency, period, float(parts[n_s:].sum()), largest))
    growing = np.real(motions.growing)
    return Vibrations(tuple(rows), float(growing.max(initial=0.0)))

"""The 28 hard cases: where multirate variational integrators break, and what counts as a pass."""

from benchmarks.hard_cases import chains, constraints, encounters, guards, large_steps, long_runs, resonance, scales
from vmri_jax.hard_cases import Case

MODULES = (chains, constraints, encounters, guards, large_steps, long_runs, resonance, scales)


def catalogue() -> tuple[Case, ...]:
    """All cases, by number."""
    found = [value for module in MODULES for value in vars(module).values() if isinstance(value, Case)]
    return tuple(sorted(found, key=lambda case: case.number))

"""The 24 hard cases of this project beside those of `vmri check`: where multirate variational integrators break, and what counts as a pass."""

from benchmarks.hard_cases import chains, constraints, encounters, large_steps, long_runs, resonance, scales
from vmri_jax.hard_cases import Case

MODULES = (chains, constraints, encounters, large_steps, long_runs, resonance, scales)


def catalogue() -> tuple[Case, ...]:
    """All cases, by number."""
    cases = [value for module in MODULES for value in vars(module).values() if isinstance(value, Case)]
    return tuple(sorted(cases, key=lambda case: case.number))

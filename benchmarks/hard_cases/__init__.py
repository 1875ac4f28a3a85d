"""Hard cases of this project beside those of `vmri check`: where multirate variational integrators break, and what counts as a pass."""

from dataclasses import replace

from benchmarks.hard_cases import chains, encounters, large_steps, long_runs, resonance
from vmri_jax.hard_cases import Case

MODULES = (resonance, large_steps, chains, long_runs, encounters)


def catalogue() -> tuple[Case, ...]:
    """All cases, numbered in the order of their modules."""
    cases = [value for module in MODULES for value in vars(module).values() if isinstance(value, Case)]
    return tuple(replace(case, number=number) for number, case in enumerate(cases, start=1))

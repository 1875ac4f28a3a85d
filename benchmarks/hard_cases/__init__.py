"""The 28 hard cases: where multirate variational integrators break, how each is set up, and what counts as a pass."""

from benchmarks.hard_cases.chains import CHAINS
from benchmarks.hard_cases.constraints import CONSTRAINTS
from benchmarks.hard_cases.encounters import CONTACT, ENCOUNTERS
from benchmarks.hard_cases.guards import GUARDS
from benchmarks.hard_cases.large_steps import EXPLICIT_LIMIT, LARGE_STEPS, SCALES_OF_STEPS
from benchmarks.hard_cases.long_runs import CHAOS, LONG_RUNS
from benchmarks.hard_cases.resonance import RESONANCES, SWAPPED
from benchmarks.hard_cases.scales import SCALES
from vmri_jax.check import Case

__all__ = ["catalogue"]


def catalogue() -> tuple[Case, ...]:
    """All cases, by number."""
    groups = (RESONANCES, (EXPLICIT_LIMIT, SWAPPED, CONTACT, CHAOS), LARGE_STEPS, CONSTRAINTS, CHAINS, SCALES_OF_STEPS)
    groups += (LONG_RUNS, ENCOUNTERS, SCALES, GUARDS)
    return tuple(sorted((case for group in groups for case in group), key=lambda case: case.number))

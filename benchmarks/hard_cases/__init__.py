"""Hard cases: where multirate variational integrators break, how each is set up, and what counts as a pass."""

from vmri_jax.hard.case import Case, Outcome
from vmri_jax.hard.chains import CHAINS
from vmri_jax.hard.constraints import CONSTRAINTS
from vmri_jax.hard.encounters import CONTACT, ENCOUNTERS
from vmri_jax.hard.guards import GUARDS
from vmri_jax.hard.large_steps import EXPLICIT_LIMIT, LARGE_STEPS, SCALES_OF_STEPS
from vmri_jax.hard.long_runs import CHAOS, LONG_RUNS
from vmri_jax.hard.own_system import cases_for
from vmri_jax.hard.report import Report, Row, run_cases
from vmri_jax.hard.resonance import RESONANCES, SWAPPED
from vmri_jax.hard.scales import SCALES

__all__ = ["Case", "Outcome", "Report", "Row", "cases_for", "catalogue", "run_cases"]


def catalogue() -> tuple[Case, ...]:
    """All cases, by number."""
    groups = (RESONANCES, (EXPLICIT_LIMIT, SWAPPED, CONTACT, CHAOS), LARGE_STEPS, CONSTRAINTS, CHAINS, SCALES_OF_STEPS)
    groups += (LONG_RUNS, ENCOUNTERS, SCALES, GUARDS)
    return tuple(sorted((case for group in groups for case in group), key=lambda case: case.number))

"""Hard cases for any system: constraints, energy, tolerance, tiny steps, reversal, the textbook, bad input."""

from vmri_jax.hard_cases.case import Case, Outcome, Report, run_cases
from vmri_jax.hard_cases.cases import cases_for, check

__all__ = ["Case", "Outcome", "Report", "cases_for", "check", "run_cases"]

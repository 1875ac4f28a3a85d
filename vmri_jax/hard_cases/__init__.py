"""Hard cases for any system: constraints, energy, tolerance, tiny steps, reversal, the textbook, bad input."""

from vmri_jax.hard_cases.case import Case, Outcome
from vmri_jax.hard_cases.cases import cases_for
from vmri_jax.hard_cases.report import Report, check, run_cases

__all__ = ["Case", "Outcome", "Report", "cases_for", "check", "run_cases"]

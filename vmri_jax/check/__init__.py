"""Hard cases put to any system: constraints, energy, tolerance, tiny steps, reversal, known methods, bad input."""

from vmri_jax.check.case import Case, Outcome
from vmri_jax.check.cases import cases_for
from vmri_jax.check.report import CasesInterrupted, Report, Row, run_cases

__all__ = ["Case", "CasesInterrupted", "Outcome", "Report", "Row", "cases_for", "run_cases"]

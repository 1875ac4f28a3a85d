"""Studies of schemes: convergence, work and precision, advice, computing time."""

from vmri_jax.accuracy.families import Family, families
from vmri_jax.study.convergence import ConvergenceStudy, convergence_study
from vmri_jax.study.row import ReferenceSolution, Row, WorkPrecision, reference_solution
from vmri_jax.study.table import Column, ResultTable
from vmri_jax.study.tuning import CostReport, Recommendation, cost_report, tune

__all__ = [
    "Column",
    "ConvergenceStudy",
    "CostReport",
    "Family",
    "Recommendation",
    "ReferenceSolution",
    "ResultTable",
    "Row",
    "WorkPrecision",
    "convergence_study",
    "cost_report",
    "families",
    "reference_solution",
    "tune",
]

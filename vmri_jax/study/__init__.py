"""Studies of schemes: convergence, work and precision, advice, computing time."""

from vmri_jax.accuracy.families import Family, families
from vmri_jax.study.convergence import ConvergenceStudy, convergence_study
from vmri_jax.study.cost_report import CostReport, cost_report
from vmri_jax.study.reference_solution import ReferenceSolution, reference_solution
from vmri_jax.study.row import Row, WorkPrecision
from vmri_jax.study.table import Column, ResultTable
from vmri_jax.study.tuning import Recommendation, tune

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

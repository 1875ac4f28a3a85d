"""Studies of schemes: convergence, work and precision, advice, computing time, and the reference study with its report."""

from vmri_jax.study.advisor import Recommendation, recommend
from vmri_jax.study.convergence import ConvergenceRow, ConvergenceStudy, convergence_study
from vmri_jax.study.cost import CostRow, CostStudy, cost_study
from vmri_jax.study.figures import Check, ConvergenceFigure, CostFigure, CostPanel, Findings
from vmri_jax.study.menu import Family, families
from vmri_jax.study.page import CostPage, cost_page
from vmri_jax.study.program import Program
from vmri_jax.study.reference import reference_figures
from vmri_jax.study.report import FigureResult, Report, choose_figures, reproduce
from vmri_jax.study.solutions import ReferenceSolution, reference_solution
from vmri_jax.study.work import WorkPrecision, WorkRow, work_precision

__all__ = [
    "Check",
    "ConvergenceFigure",
    "ConvergenceRow",
    "ConvergenceStudy",
    "CostFigure",
    "CostPage",
    "CostPanel",
    "CostRow",
    "CostStudy",
    "Family",
    "FigureResult",
    "Findings",
    "Program",
    "Recommendation",
    "ReferenceSolution",
    "Report",
    "WorkPrecision",
    "WorkRow",
    "choose_figures",
    "convergence_study",
    "cost_page",
    "cost_study",
    "families",
    "recommend",
    "reference_figures",
    "reference_solution",
    "reproduce",
    "work_precision",
]

"""Studies of schemes: convergence, computing time, and the reference study with its report."""

from vmri_jax.study.convergence import (
    ConvergenceRow,
    ConvergenceStudy,
    ReferenceSolution,
    convergence_study,
    reference_solution,
)
from vmri_jax.study.cost import CostRow, CostStudy, cost_study
from vmri_jax.study.figures import Check, ConvergenceFigure, CostFigure, CostPanel, Findings
from vmri_jax.study.reference import reference_figures
from vmri_jax.study.report import FigureResult, Report, choose_figures, reproduce

__all__ = [
    "Check",
    "ConvergenceFigure",
    "ConvergenceRow",
    "ConvergenceStudy",
    "CostFigure",
    "CostPanel",
    "CostRow",
    "CostStudy",
    "FigureResult",
    "Findings",
    "ReferenceSolution",
    "Report",
    "choose_figures",
    "convergence_study",
    "cost_study",
    "reference_figures",
    "reference_solution",
    "reproduce",
]

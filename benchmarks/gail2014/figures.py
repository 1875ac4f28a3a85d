"""Kinds of figures of a study: what is run, what is expected, and how it is judged and drawn."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import reduce
from operator import add

import jax
import numpy as np
from matplotlib.figure import Figure

import vmri_jax as vm
from benchmarks.gail2014.cost import CostStudy, Curve, cost_study, plot_cost
from vmri_jax import plots
from vmri_jax.running.progress import Progress, part
from vmri_jax.study import ConvergenceStudy, convergence_study, reference_solution

ORDER_TOLERANCE = 0.2
UPTURN = 1.5
"""A cost that grows by more than this turns up again; smaller changes may be the machine's."""
SETTLED = 10
"""From about so many micro steps on, the structured solve should cost the same per micro step."""


SAMPLE = 0.02
"""Least seconds of a sample of a time.

The medians of several short samples in turns bear a busy machine better than means of long ones.
"""
NO_OVERHEAD = "compiled code has hardly any cost of a macro step that more micro steps could share"
"""Why a dense solve is cheapest with fewer micro steps here than in the paper."""
LONG_STEPS = (
    "longer macro steps take more passes of Newton's iteration, and newer matrices: in macro steps of one length the "
    "cost is {:.2f} times"
)
"""Reason for which the cost of a structured solve grows with the macro step, while macro steps of one length cost the
same."""


@contextmanager
def compiled_quickly() -> Iterator[None]:
    """Within this context programs are compiled without most optimisations, in half the time: for errors, not for
    times."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", True)
    try:
        yield
    finally:
        jax.config.update("jax_disable_most_optimizations", before)


@dataclass(frozen=True)
class Check:
    """One number held against what the source, e.g. "paper" or "theory", expects of it.

    kind: "order"; "turn" or "minimum" of the dense solve; "structured", in macro steps of one length, or "longer", in
        macro steps that grow with the number of micro steps.
    reason: why the number is known to differ from the source; empty where it has to agree.
    """

    quantity: str
    expected: str
    source: str
    seen: str
    agrees: bool
    kind: str = "order"
    reason: str = ""

    @property
    def surprises(self) -> bool:
        """Whether the number differs from the source without a known reason."""
        return not self.agrees and not self.reason


@dataclass(frozen=True)
class Findings:
    """What measuring a figure gave; `seen` is one line, ``draw(theme)`` makes the figure."""

    seen: str
    checks: tuple[Check, ...]
    draw: Callable[[plots.Theme], Figure]
    study: ConvergenceStudy | CostStudy


@dataclass(frozen=True)
class ConvergenceFigure:
    """Errors of schemes against the macro step.

    name, title: on the command line and in the report.
    paper: what the paper saw, one line.
    problem: makes the problem; figures with the same function share its reference solution.
    orders: what the source expects.
    """

    name: str
    title: str
    paper: str
    problem: Callable[[], vm.Problem]
    schemes: Mapping[str, vm.Scheme]
    orders: Mapping[str, int]
    source: str
    macro_dt: tuple[float, ...]
    t_end: float = 1.0

    def measure(self, progress: Progress, references: dict) -> Findings:
        """Run it; `references` keeps reference solutions from figure to figure."""
        problem = self.problem()
        if self.problem not in references:
            progress("reference solution", 0, 1)
            with compiled_quickly():
                references[self.problem] = reference_solution(problem, self.t_end)
        how = {"reference": references[self.problem], "progress": progress}
        with compiled_quickly():
            study = convergence_study(problem, self.schemes, self.macro_dt, self.t_end, **how)
        orders = sorted(set(self.orders.values()))
        return Findings(
            seen=self._seen(study),
            checks=self._checks(study),
            draw=lambda theme: plots.plot_convergence(study, orders, "", theme),
            study=study,
        )

    def _seen(self, study: ConvergenceStudy) -> str:
        orders = [f"{label}: {study.order(label, 'q'):.2f} / {study.order(label, 'p'):.2f}" for label in study.schemes]
        known = study.references[""]
        reference = f"reference good to {known.error_q:.0e} / {known.error_p:.0e}"
        failed = sum(row.result not in ("CONVERGED", "CONVERGED_AT_ROUNDOFF") for row in study.rows)
        failures = [f"{failed} of {len(study.rows)} runs failed"] if failed else []
        return "; ".join(["orders of positions / momenta, " + orders[0], *orders[1:], reference, *failures]) + "."

    def _checks(self, study: ConvergenceStudy) -> tuple[Check, ...]:
        checks = []
        for label, expected in self.orders.items():
            for quantity, name in (("q", "positions"), ("p", "momenta")):
                order = study.order(label, quantity)
                agrees = abs(order - expected) <= ORDER_TOLERANCE
                checks.append(Check(f"order of {name}, {label}", f"{expected}", self.source, f"{order:.2f}", agrees))
        return tuple(checks)


@dataclass(frozen=True)
class CostPanel:
    """Computing time of one scheme on one system, by the dense and by the structured solve.

    dense, structured: make the problem that each solver gets; dense_num_micro and dense_t_end are those of the first.
    paper_minimum: the num_micro that was cheapest in the paper, None if it does not say.
    others: further matrices of `vmri_jax.Solver`, on the structured problem.
    """

    title: str
    dense: Callable[[], vm.Problem]
    structured: Callable[[], vm.Problem]
    scheme: Callable[[int], vm.Scheme]
    paper_minimum: int | None
    dense_num_micro: tuple[int, ...]
    num_micro: tuple[int, ...]
    micro_dt: float
    dense_t_end: float
    t_end: float
    repeats: int
    others: tuple[str, ...] = ()

    def measure(self, progress: Progress) -> CostStudy:
        """Time all solvers in turns."""
        structured = self.structured()
        curves = [Curve("dense", self.dense(), self.dense_num_micro, self.dense_t_end)]
        settled = min(self.num_micro, key=lambda n: abs(n - SETTLED))
        methods = ("exact", *self.others)
        curves += [Curve(method, structured, self.num_micro, self.t_end, settled) for method in methods]
        how = {"micro_dt": self.micro_dt, "repeats": self.repeats, "min_seconds": SAMPLE, "progress": progress}
        return cost_study(self.title, self.scheme, curves, **how)


@dataclass(frozen=True)
class CostFigure:
    """Computing time against num_micro, in one or several panels."""

    name: str
    title: str
    paper: str
    panels: tuple[CostPanel, ...]

    def measure(self, progress: Progress, references: dict) -> Findings:
        """Run all panels."""
        studies = {
            panel.title: panel.measure(part(progress, i, len(self.panels))) for i, panel in enumerate(self.panels)
        }
        minima = {panel.title: panel.paper_minimum for panel in self.panels if panel.paper_minimum is not None}
        return Findings(
            seen="; ".join(_seen_cost(panel, studies[panel.title]) for panel in self.panels) + ".",
            checks=tuple(check for panel in self.panels for check in _cost_checks(panel, studies[panel.title])),
            draw=lambda theme: plot_cost(studies, minima, theme=theme),
            study=reduce(add, studies.values()),
        )


def _summary(study: CostStudy, label: str, solver: str) -> tuple[int, float, int, float]:
    """Cheapest num_micro and its cost, largest num_micro that ran and how many times as much that costs."""
    num_micro, cost = study.curve(label, solver)
    ran = np.isfinite(cost)
    if not ran.any():
        return 0, float("nan"), 0, float("nan")
    num_micro, cost = num_micro[ran], cost[ran]
    best = int(np.argmin(cost))
    return int(num_micro[best]), cost[best], int(num_micro[-1]), cost[-1] / cost[best]


def _seen_cost(panel: CostPanel, study: CostStudy) -> str:
    parts = []
    for label, solver in study.curves:
        best, least, last, ratio = _summary(study, label, solver)
        us = f"{least:.{0 if least > 100 else 2}f} µs"
        parts.append(f"{solver} cheapest at {best} ({us}) and {ratio:.1f} × that at {last}")
    return f"{panel.title}: " + ", ".join(parts)


def _cost_checks(panel: CostPanel, study: CostStudy) -> list[Check]:
    best, _, last, ratio = _summary(study, panel.title, "dense")
    seen, turns = f"{ratio:.1f} × its minimum at {last}", bool(ratio > UPTURN)
    checks = [Check(f"{panel.title}, dense: cost turns up again", "yes", "paper", seen, turns, "turn")]
    if panel.paper_minimum is not None:
        quantity = f"{panel.title}, dense: cheapest number of micro steps"
        agrees = panel.paper_minimum / 2 <= best <= 2 * panel.paper_minimum
        reason = NO_OVERHEAD if best < panel.paper_minimum else ""
        checks.append(Check(quantity, f"{panel.paper_minimum}", "paper", f"{best}", agrees, "minimum", reason))
    rows = [row for row in study.rows if row.method == "exact"]
    settled, most = min(rows, key=lambda row: abs(row.num_micro - SETTLED)), rows[-1]
    ratio = most.us_per_micro_step / settled.us_per_micro_step
    in_short_step = ratio if most is settled else most.us_in_short_step / settled.us_per_micro_step
    quantity = f"{panel.title}, exact: cost at {most.num_micro} micro steps over that at {settled.num_micro}"
    bound = f"at most {UPTURN:g}", "theory"
    of_one_length = (
        f"{quantity}, in macro steps of one length",
        *bound,
        f"{in_short_step:.2f}",
        in_short_step <= UPTURN,
    )
    reason = LONG_STEPS.format(in_short_step) if in_short_step <= UPTURN else ""
    of_one_micro_step = quantity, *bound, f"{ratio:.2f}", ratio <= UPTURN, "longer", reason
    return [*checks, Check(*of_one_length, "structured"), Check(*of_one_micro_step)]

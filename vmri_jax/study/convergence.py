"""Convergence studies: errors of schemes over macro steps against a fine reference solution.

The error of a run is the largest difference over all saved nodes and all coordinates, slow and fast,

    error_q = max |q - q_ref|        error_p = max |p - p_ref|.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from operator import attrgetter, itemgetter
from typing import Any

import jax
import numpy as np

from vmri_jax import diagnostics, plots
from vmri_jax.diagnostics import OrderFit
from vmri_jax.executors.executor import mapped
from vmri_jax.mechanics.state import HasProblem, Problem, problem_of
from vmri_jax.refusals import Refused
from vmri_jax.running.arguments import Save, check_step_size, steps_until
from vmri_jax.running.interrupts import Interrupted
from vmri_jax.running.prepare import prepare
from vmri_jax.running.progress import Progress, progress_to
from vmri_jax.running.simulation import Simulation
from vmri_jax.running.timing import interleaved
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.schemes.composition import SchemeLike
from vmri_jax.steppers.solver import Solver
from vmri_jax.study.row import ReferenceSolution, Row, RunTable, WorkPrecision, reference_solution, row_of
from vmri_jax.study.table import Column, interruptible

MIN_ERROR_OVER_REFERENCE = 100.0
"""Least ratio of a fitted error to the error of the reference; at it the
reference changes the error of the scheme by 1 %; a larger ratio fits fewer runs."""


def _order(fit: OrderFit) -> str:
    """The text of an observed order with its uncertainty."""
    if not np.isfinite(fit.order):
        return "-"
    return f"{fit.order:.2f}" + (f" ± {fit.half_width:.2f}" if np.isfinite(fit.half_width) else "")


OF_FINEST = {
    "smallest H": ("macro_dt", "g"),
    "error of q": ("error_q", ".1e"),
    "error of p": ("error_p", ".1e"),
    "energy": ("energy_error", ".1e"),
}
"""Columns about the run with the smallest step that did not fail: its attributes and their formats."""


@dataclass(frozen=True, repr=False)
class ConvergenceStudy(RunTable):
    """Rows of a convergence study, sorted by scheme, then by case, then by macro step in the order of the call.

    The column "energy" of its table is the error of the energy, see `Row`, at the smallest step.

    references: reference solutions by case.
    """

    columns = (
        *(Column(name, itemgetter(name)) for name in ("scheme", "case")),
        *(Column(name, itemgetter(name), right=True) for name in ("order of q", "order of p", *OF_FINEST, "failed")),
    )
    rows: tuple[Row, ...]
    references: Mapping[str, ReferenceSolution]

    @property
    def cases(self) -> list[str]:
        """Labels of the parameters."""
        return list(self.references)

    def errors(self, scheme: str, quantity: str = "q", case: str | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Macro steps, largest first, and errors of one scheme in "q" or "p"; failed runs are NaN.

        Args:
            case: label of the parameters, the first one by default.
        """
        case = self.cases[0] if case is None else case
        rows = sorted((r for r in self.rows if (r.scheme, r.case) == (scheme, case)), key=lambda row: -row.macro_dt)
        if not rows:
            cases = f" and the cases {', '.join(self.cases)}" if len(self.cases) > 1 else ""
            raise Refused(f"errors: no scheme {scheme!r} in this study; it has {', '.join(self.schemes)}{cases}.")
        return np.array([row.macro_dt for row in rows]), np.array([getattr(row, f"error_{quantity}") for row in rows])

    def usable(self, scheme: str, quantity: str = "q", case: str | None = None) -> tuple[np.ndarray, np.ndarray]:
        """`errors` without failed runs and without errors too near the error of the reference."""
        macro_dt, errors = self.errors(scheme, quantity, case)
        floor = getattr(self.references[self.cases[0] if case is None else case], f"error_{quantity}")
        usable = np.isfinite(errors) & (errors > MIN_ERROR_OVER_REFERENCE * floor)
        return macro_dt[usable], errors[usable]

    def fit(self, scheme: str, quantity: str = "q", points: int = 4, case: str | None = None) -> OrderFit:
        """Slope of log error over log step through the last `points` usable errors, with its uncertainty.

        NaN where fewer than two errors are usable.
        """
        macro_dt, errors = self.usable(scheme, quantity, case)
        if len(errors) < 2:
            return OrderFit(np.nan, np.nan, len(errors))
        return diagnostics.fit_order(macro_dt[-points:], errors[-points:])

    def order(self, scheme: str, quantity: str = "q", points: int = 4, case: str | None = None) -> float:
        """Observed order: the slope of `fit`."""
        return self.fit(scheme, quantity, points, case).order

    def shown(self) -> list[dict[str, str]]:
        """Observed orders, and the errors at the smallest step that did not fail, by column."""
        lines = []
        for scheme, case in product(self.schemes, self.cases):
            runs = [row for row in self.rows if (row.scheme, row.case) == (scheme, case)]
            failed = sum(row.failed for row in runs)
            finest = min((row for row in runs if not row.failed), key=attrgetter("macro_dt"), default=None)
            orders = {f"order of {quantity}": _order(self.fit(scheme, quantity, case=case)) for quantity in ("q", "p")}
            line = {"scheme": scheme, "case": case, "failed": f"{failed} of {len(runs)}" if failed else ""} | orders
            for column, (name, form) in OF_FINEST.items():
                line[column] = "-" if finest is None else format(getattr(finest, name), form)
            lines.append(line)
        return lines

    def work(self, case: str | None = None) -> WorkPrecision:
        """The runs of a case, the first one by default, by their errors and their work; times where the study has
        them."""
        case = self.cases[0] if case is None else case
        return WorkPrecision(tuple(row for row in self.rows if row.case == case), self.references[case])

    def plot(self, title: str = "", orders: Sequence[int] = ()):
        """Errors against the macro step, with guides of the slopes `orders`, see `vmri_jax.plots.plot_convergence`."""
        return plots.plot_convergence(self, orders, title)

    def to_xarray(self):
        """An `xarray.Dataset` over (scheme, case, macro_dt); needs the extra ``vmri_jax[xarray]``."""
        steps = sorted({row.macro_dt for row in self.rows}, reverse=True)
        data = self.to_pandas().set_index(["scheme", "case", "macro_dt"]).to_xarray()
        return data.reindex(scheme=self.schemes, case=self.cases, macro_dt=steps)


def convergence_study(
    problem: Problem | HasProblem,
    schemes: Mapping[str, SchemeLike],
    macro_dt: Sequence[float],
    t_end: float,
    *,
    num_saves: int = 10,
    params: Mapping[str, Any] | None = None,
    reference: ReferenceSolution | Mapping[str, ReferenceSolution] | None = None,
    solver: Solver | None = None,
    repeats: int = 0,
    executor: Any = None,
    progress: Any = False,
) -> ConvergenceStudy:
    """Run every scheme with every macro step to `t_end` and compare with a reference.

    Each scheme is compiled once for all its step sizes and sets of parameters. A run that fails becomes a row of NaN
    with its status.

    Args:
        problem: system and start; a `Problem` or a scene.
        schemes: schemes by label, of any num_micro and degree.
        macro_dt: macro steps H; each must divide `t_end` into a multiple of `num_saves` steps.
        t_end: time simulated.
        num_saves: nodes compared, equally spaced over `t_end`.
        params: parameters of the system by label, if there are several sets, with the start of `problem`.
        reference: what errors are measured against, by label of several sets; by default `reference_solution`.
        solver: how implicit equations are solved.
        repeats: timed samples of every run; 0 for no times. The runs take turns on the clock of this process, so that a
            slow moment of the machine hits all of them; a row has the median.
        executor: where runs are computed, as of `vmri_jax.ensemble`; None for this process.
        progress: True for a bar, or a function (what, done, total) that is told about every run before it starts.

    Raises:
        ValueError: no scheme, a step that does not divide `t_end` into a multiple of `num_saves` steps, a reference of
            another shape.
        Interrupted: Ctrl-C; carries the study of the runs that were done.
    """
    with progress_to("convergence_study", progress) as tell:
        problem = problem_of("convergence_study", problem)
        if not schemes:
            raise Refused(
                "convergence_study: schemes is empty; give at least one, e.g. {'midpoint': fully_implicit(5)}."
            )
        steps = [_num_steps(t_end, dt, num_saves) for dt in macro_dt]
        if not steps:
            raise Refused("convergence_study: macro_dt is empty; give the macro steps to run.")
        cases = _cases(problem, params, reference, t_end, num_saves, tell)
        labels = list(product(schemes, cases, steps))
        arguments = [(cases[case][0], schemes[label], t_end, num_saves, solver, n) for label, case, n in labels]
        total = len(labels)

        def told(done: int, i: int) -> None:
            tell(f"{labels[i][0]}, H = {t_end / labels[i][2]:g}", done, total)

        stopped = None
        try:
            runs = mapped("convergence_study", _run, arguments, executor, told)
        except Interrupted as interrupted:
            runs, stopped = interrupted.done, interrupted
        energies, rows = {case: _energies(*of_case) for case, of_case in cases.items()}, []
        for (label, case, n), run in zip(labels, runs, strict=True):
            if run is not None:
                problem, reference = cases[case]
                errors = dict(zip(("error_q", "error_p"), reference.errors(run), strict=True))
                numbers = t_end / n, n, energies[case]
                rows.append(row_of(label, problem.system, schemes[label], run, *numbers, **errors, case=case))
        study = ConvergenceStudy(tuple(rows), {case: reference for case, (_, reference) in cases.items()})
        if stopped is not None:
            raise Interrupted(study, len(rows), None, "runs") from None
        if repeats:
            with interruptible(lambda: study):
                tell("measuring times", total, total)
                timed = {str(i): _prepared(*arguments[i]).timed() for i, row in enumerate(rows) if not row.failed}
                samples = interleaved(timed, repeats)
            seconds = [float(np.median(samples.get(str(i), [np.nan]))) for i in range(total)]
            rows = [replace(row, seconds=each) for row, each in zip(rows, seconds, strict=True)]
            study = replace(study, rows=tuple(rows))
        tell("done", total, total)
        return study


Case = tuple[Problem, ReferenceSolution]
"""The problem with a set of parameters, and its reference solution."""


def _cases(problem: Problem, params, reference, t_end: float, num_saves: int, progress: Progress) -> dict[str, Case]:
    """The cases of `convergence_study` by label; refuses references with other labels or of another shape."""
    if params is not None and not params:
        raise Refused("convergence_study: params is empty; give a set of parameters by label, or leave it out.")
    sets = {"": problem.system.params} if params is None else params
    problems = {label: replace(problem, system=problem.system.replace(params=p)) for label, p in sets.items()}
    if reference is None:
        how = {"num_saves": num_saves, "progress": progress}
        reference = {label: reference_solution(problem, t_end, **how) for label, problem in problems.items()}
    elif not isinstance(reference, Mapping) and len(problems) == 1:
        reference = dict.fromkeys(problems, reference)
    if not isinstance(reference, Mapping) or set(reference) != set(problems):
        raise Refused(f"convergence_study: reference must be a mapping with the labels of params, {list(problems)}.")
    shape = (num_saves + 1, problem.q_s.size + problem.q_f.size)
    for label in problems:
        shapes = reference[label].q.shape, reference[label].p.shape
        if shapes != (shape, shape):
            nodes = "num_saves + 1 nodes from the start to t_end, slow coordinates first"
            raise Refused(f"convergence_study: reference has shapes {shapes}; both must be {shape}: {nodes}.")
    return {label: (problem, reference[label]) for label, problem in problems.items()}


def _energies(problem: Problem, reference: ReferenceSolution) -> np.ndarray | None:
    """(num_saves + 1,) energies of the reference; None where the system keeps its energy: the energy at the start then
    serves."""
    if problem.system.keeps_energy:
        return None
    phase = [part for array in (reference.q, reference.p) for part in np.split(array, [problem.q_s.size], axis=1)]
    return np.asarray(jax.jit(jax.vmap(partial(diagnostics.energy, problem.system)))(*phase))


def _prepared(problem: Problem, scheme, t_end: float, num_saves: int, solver, num_steps: int) -> Simulation:
    steps = {"macro_dt": t_end / num_steps, "num_steps": num_steps, "save": num_steps // num_saves}
    return prepare(problem, scheme, **steps, solver=solver)


def _run(*arguments) -> Trajectory:
    """A run with arguments of `_prepared`."""
    return _prepared(*arguments)(throw=False)


def _num_steps(t_end: float, macro_dt: float, num_saves: int) -> int:
    """The number of macro steps up to `t_end`."""
    check_step_size(macro_dt, "convergence_study")
    num_steps = steps_until(t_end, 0.0, macro_dt)
    Save(number=num_saves).macro_steps(num_steps)
    return num_steps

"""Convergence studies: errors of schemes over macro steps against a fine reference solution.

The error of a run is the largest difference over all saved nodes and all coordinates, slow and fast,

    error_q = max |q - q_ref|        error_p = max |p - p_ref|.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax import diagnostics, plots
from vmri_jax.diagnostics import OrderFit
from vmri_jax.ensembles.executors import mapped
from vmri_jax.mechanics.state import HasProblem, Problem, problem_of
from vmri_jax.running.batch import simulate_batch
from vmri_jax.running.export import extra
from vmri_jax.running.interrupts import Interrupted
from vmri_jax.running.progress import shows_progress
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.results import Method, Result
from vmri_jax.steppers.solvers import Newton
from vmri_jax.study.program import Program
from vmri_jax.study.reference_solution import ReferenceSolution, reference_solution
from vmri_jax.study.table import Column, ResultTable

FLOOR_FACTOR = 100.0
"""Errors below this many times the error of the reference say nothing about the scheme and are not fitted."""


@dataclass(frozen=True)
class ConvergenceRow:
    """One run: how wrong it is, what it keeps, how it went.

    case: label of the parameters, "" if there is one set only.
    error_q, error_p: of positions and momenta.
    energy_error, energy_drift, energy_band: largest error of the energy; change over the run of the straight line fitted to this
        error; largest distance from that line. The error is the change since the start where the system keeps its energy; where forces or
        moving constraints do work, it is the difference from the energy of the reference.
    momentum_error: largest change of a momentum map since the start.
    constraint_residual: largest constraint value, of positions or velocities.
    iterations, method, result: most Newton iterations of a step, costliest `Method`, `Result`.
    """

    scheme: str
    case: str
    num_micro: int
    degree: int
    macro_dt: float
    error_q: float
    error_p: float
    energy_error: float
    energy_drift: float
    energy_band: float
    momentum_error: float
    constraint_residual: float
    iterations: int
    method: str
    result: str


@dataclass(frozen=True)
class SchemeSummary:
    """One scheme with one set of parameters: its runs and observed orders of positions and momenta."""

    runs: tuple[ConvergenceRow, ...]
    fit_q: OrderFit
    fit_p: OrderFit

    @property
    def finest(self) -> ConvergenceRow | None:
        """The run with the smallest step that did not fail."""
        ran = [row for row in self.runs if np.isfinite(row.error_q)]
        return min(ran, key=lambda row: row.macro_dt, default=None)

    @property
    def failures(self) -> str:
        """How many of the runs failed; empty if none did."""
        failed = sum(not np.isfinite(row.error_q) for row in self.runs)
        return f"{failed} of {len(self.runs)}" if failed else ""


def _order(fit: OrderFit) -> str:
    if not np.isfinite(fit.order):
        return "-"
    return f"{fit.order:.2f}" + (f" ± {fit.half_width:.2f}" if np.isfinite(fit.half_width) else "")


def _of_finest(name: str, form: str = ".1e") -> Callable[[SchemeSummary], str]:
    """The text of a number of the finest run."""
    return lambda summary: "-" if summary.finest is None else format(getattr(summary.finest, name), form)


@dataclass(frozen=True)
class ConvergenceStudy(ResultTable):
    """Rows of a convergence study, schemes one after the other, then cases, and macro steps as given.

    The column "energy" of its table is the error of the energy, see `ConvergenceRow`, at the smallest step.

    references: reference solutions by case.
    """

    columns = (
        Column("scheme", lambda summary: summary.runs[0].scheme),
        Column("case", lambda summary: summary.runs[0].case),
        Column("order of q", lambda summary: _order(summary.fit_q), right=True),
        Column("order of p", lambda summary: _order(summary.fit_p), right=True),
        Column("smallest H", _of_finest("macro_dt", "g"), right=True),
        Column("error of q", _of_finest("error_q"), right=True),
        Column("error of p", _of_finest("error_p"), right=True),
        Column("energy", _of_finest("energy_error"), right=True),
        Column("failed", lambda summary: summary.failures, right=True),
    )
    rows: tuple[ConvergenceRow, ...]
    references: Mapping[str, ReferenceSolution]

    @property
    def schemes(self) -> list[str]:
        """Labels of the schemes."""
        return list(dict.fromkeys(row.scheme for row in self.rows))

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
            raise ValueError(f"errors: no scheme {scheme!r} in this study; it has {', '.join(self.schemes)}{cases}.")
        return np.array([row.macro_dt for row in rows]), np.array([getattr(row, f"error_{quantity}") for row in rows])

    def usable(self, scheme: str, quantity: str = "q", case: str | None = None) -> tuple[np.ndarray, np.ndarray]:
        """`errors` of the runs that did not fail and lie well above the error of the reference."""
        macro_dt, errors = self.errors(scheme, quantity, case)
        floor = getattr(self.references[self.cases[0] if case is None else case], f"error_{quantity}")
        usable = np.isfinite(errors) & (errors > FLOOR_FACTOR * floor)
        return macro_dt[usable], errors[usable]

    def fit(self, scheme: str, quantity: str = "q", points: int = 4, case: str | None = None) -> OrderFit:
        """Slope of log error over log step through the last `points` usable errors, and how certain it is.

        NaN where fewer than two runs can be used.
        """
        macro_dt, errors = self.usable(scheme, quantity, case)
        if len(errors) < 2:
            return OrderFit(np.nan, np.nan, len(errors))
        return diagnostics.fit_order(macro_dt[-points:], errors[-points:])

    def order(self, scheme: str, quantity: str = "q", points: int = 4, case: str | None = None) -> float:
        """Observed order: that of `fit`."""
        return self.fit(scheme, quantity, points, case).order

    def shown(self) -> list[SchemeSummary]:
        """Observed orders, and the errors at the smallest step that did not fail."""
        return [self._summary(scheme, case) for scheme in self.schemes for case in self.cases]

    def _summary(self, scheme: str, case: str) -> SchemeSummary:
        runs = tuple(row for row in self.rows if (row.scheme, row.case) == (scheme, case))
        return SchemeSummary(runs, self.fit(scheme, "q", case=case), self.fit(scheme, "p", case=case))

    def content(self) -> dict[str, Any]:
        """The rows, and how accurate the references are."""
        references = {case: {"error_q": r.error_q, "error_p": r.error_p} for case, r in self.references.items()}
        return {"references": references, **super().content()}

    def plot(self, title: str = "", orders: Sequence[int] = ()):
        """Errors against the macro step, with guides of the slopes `orders`, see `vmri_jax.plots.plot_convergence`."""
        return plots.plot_convergence(self, orders, title)

    def to_xarray(self):
        """An `xarray.Dataset` over (scheme, case, macro_dt); needs the extra ``vmri_jax[xarray]``."""
        xarray = extra("xarray", "to_xarray")
        steps = sorted({row.macro_dt for row in self.rows}, reverse=True)
        axes = {"scheme": self.schemes, "case": self.cases, "macro_dt": steps}
        shape = tuple(len(values) for values in axes.values())
        names = ("error_q", "error_p", "energy_error", "energy_drift", "energy_band", "momentum_error")
        data: dict[str, Any] = {name: np.full(shape, np.nan) for name in (*names, "constraint_residual", "iterations")}
        data |= {name: np.full(shape, "", dtype="U24") for name in ("method", "result")}
        for row in self.rows:
            at = tuple(values.index(getattr(row, axis)) for axis, values in axes.items())
            for name, array in data.items():
                array[at] = getattr(row, name)
        return xarray.Dataset({name: (tuple(axes), array) for name, array in data.items()}, coords=axes)


@shows_progress
def convergence_study(
    problem: Problem | HasProblem,
    schemes: Mapping[str, Scheme | Composition],
    macro_dt: Sequence[float],
    t_end: float,
    *,
    num_saves: int = 10,
    params: Mapping[str, Any] | None = None,
    momentum_maps: Sequence[Callable] = (),
    reference: ReferenceSolution | Mapping[str, ReferenceSolution] | None = None,
    solver: Newton | None = None,
    executor: Any = None,
    progress: Any = False,
) -> ConvergenceStudy:
    """Run every scheme with every macro step to `t_end` and compare with a reference.

    Each scheme is compiled once for all its step sizes. Runs with several sets of parameters are computed side by side.
    A run that fails becomes a row of NaN with its status.

    Args:
        problem: system and start; a `Problem` or a scene.
        schemes: schemes by label, of any num_micro and degree.
        macro_dt: macro steps H; each must divide `t_end` into a multiple of `num_saves` steps.
        t_end: time simulated.
        num_saves: nodes compared, equally spaced over `t_end`.
        params: parameters of the system by label, if there are several sets; positions and velocities at the start are
            those of `problem`.
        momentum_maps: infinitesimal generators of symmetries, see `vmri_jax.diagnostics.momentum_map`.
        reference: compare with this (by label of the parameters if there are several); by default `reference_solution`.
        solver: how implicit equations are solved.
        executor: where runs are computed, as of `vmri_jax.ensemble`; None for this process.
        progress: True for a bar, or a function (what, done, total) that is told about every run before it starts.

    Raises:
        ValueError: no scheme, a step that does not divide `t_end` as above, a reference of another shape.
        Interrupted: Ctrl-C; carries the study of the runs that were done.
    """
    problem = problem_of("convergence_study", problem)
    if not schemes:
        raise ValueError(
            "convergence_study: schemes is empty; give at least one, e.g. {'midpoint': fully_implicit(5)}."
        )
    steps = [_num_steps(t_end, dt, num_saves) for dt in macro_dt]
    if not steps:
        raise ValueError("convergence_study: macro_dt is empty; give the macro steps to run.")
    cases = _cases(problem, params)
    total = len(schemes) * len(steps)
    references = _references(cases, reference, t_end, num_saves, progress, total)

    problems = list(cases.values())
    labels = [(label, num_steps) for label in schemes for num_steps in steps]
    stopped = None
    try:
        runs = mapped(
            "convergence_study",
            _runs,
            [(problems, schemes[label], num_steps, t_end, num_saves, solver) for label, num_steps in labels],
            executor,
            lambda done, i: progress(f"{labels[i][0]}, H = {t_end / labels[i][1]:g}", done, total),
        )
    except Interrupted as interrupted:
        runs, stopped = interrupted.done, interrupted
    done = {label: run for label, run in zip(labels, runs, strict=True) if run is not None}
    energies = {case: _energies(changed, references[case]) for case, changed in cases.items()}
    rows = [
        _row(
            label,
            case,
            scheme,
            t_end / num_steps,
            changed.system,
            momentum_maps,
            done[label, num_steps][k],
            references[case],
            energies[case],
        )
        for label, scheme in schemes.items()
        for k, (case, changed) in enumerate(cases.items())
        for num_steps in steps
        if (label, num_steps) in done
    ]
    study = ConvergenceStudy(tuple(rows), references)
    if stopped is not None:
        raise Interrupted(study, len(study.rows), None, "runs") from None
    progress("done", total, total)
    return study


def _cases(problem: Problem, params: Mapping[str, Any] | None) -> dict[str, Problem]:
    """The problem with every set of parameters, by label."""
    if params is None:
        return {"": problem}
    if not params:
        raise ValueError("convergence_study: params is empty; give a set of parameters by label, or leave it out.")
    return {case: replace(problem, system=problem.system.replace(params=p)) for case, p in params.items()}


def _runs(
    problems: Sequence[Problem], scheme, num_steps: int, t_end: float, num_saves: int, solver
) -> list[Trajectory]:
    """A trajectory of each problem."""
    if len(problems) == 1:
        return [Program(problems[0], scheme, t_end, num_saves, solver)(num_steps)]
    states = jax.tree.map(lambda *a: jnp.stack(a), *(problem.state() for problem in problems))
    params = jax.tree.map(lambda *a: jnp.stack([jnp.asarray(x) for x in a]), *(p.system.params for p in problems))
    batch = simulate_batch(
        problems[0].system,
        scheme,
        states,
        macro_dt=t_end / num_steps,
        num_steps=num_steps,
        save_every=num_steps // num_saves,
        params=params,
        solver=solver,
        warn=False,
    )
    return [jax.tree.map(lambda a, i=i: a[i], batch) for i in range(len(problems))]


def _references(cases, reference, t_end, num_saves, progress, total) -> dict[str, Any]:
    """A reference of the right shape for every case."""
    if reference is None:

        def told(what: str, *_) -> None:
            progress(what, 0, total)

        return {
            case: reference_solution(problem, t_end, num_saves=num_saves, progress=told)
            for case, problem in cases.items()
        }
    references: dict[str, Any] = dict(reference if isinstance(reference, Mapping) else dict.fromkeys(cases, reference))
    if set(references) != set(cases) or (len(cases) > 1 and not isinstance(reference, Mapping)):
        raise ValueError(
            f"convergence_study: params has the labels {list(cases)}, so reference must be a mapping with the same ones."
        )
    for case, problem in cases.items():
        shape = (num_saves + 1, problem.q_s.size + problem.q_f.size)
        found = references[case]
        if found.q.shape != shape or found.p.shape != shape:
            raise ValueError(
                f"convergence_study: reference has q of shape {found.q.shape} and p of shape {found.p.shape}; both "
                f"must be {shape}: num_saves + 1 nodes from the start to t_end, slow coordinates first."
            )
    return references


def _num_steps(t_end: float, macro_dt: float, num_saves: int) -> int:
    num_steps = round(t_end / macro_dt) if macro_dt > 0 else 0
    if num_steps < 1 or abs(num_steps * macro_dt - t_end) > 1e-9 * t_end or num_steps % num_saves:
        raise ValueError(
            f"convergence_study: macro_dt = {macro_dt:g} makes {t_end / macro_dt if macro_dt else float('inf'):.6g} steps "
            f"up to t_end = {t_end:g}; it must make a multiple of num_saves = {num_saves} whole steps, so that every run "
            "saves the same times."
        )
    return num_steps


def _energies(problem: Problem, reference: ReferenceSolution) -> np.ndarray | None:
    """(num_saves + 1,) energies of a reference; None where the system keeps its energy, so that the start tells it."""
    if problem.system.keeps_energy:
        return None
    phase = [part for both in (reference.q, reference.p) for part in np.split(both, [problem.q_s.size], axis=1)]
    return np.asarray(jax.jit(jax.vmap(partial(diagnostics.energy, problem.system)))(*phase))


def _row(label, case, scheme, macro_dt, system, momentum_maps, trajectory, reference, energies) -> ConvergenceRow:
    error_q, error_p = reference.errors(trajectory)
    energy = np.asarray(trajectory.energy)
    off = energy - (energy[0] if energies is None else energies)
    drift, band = _drift_and_band(np.asarray(trajectory.t), off)
    _, *phase = vars(trajectory.states).values()
    maps = [np.asarray(jax.vmap(lambda *z, xi=xi: diagnostics.momentum_map(xi, *z))(*phase)) for xi in momentum_maps]
    return ConvergenceRow(
        scheme=label,
        case=case,
        num_micro=scheme.num_micro,
        degree=scheme.degree,
        macro_dt=macro_dt,
        error_q=error_q,
        error_p=error_p,
        energy_error=float(np.abs(off).max()),
        energy_drift=drift,
        energy_band=band,
        momentum_error=float(max((np.abs(m - m[0]).max() for m in maps), default=0.0)),
        constraint_residual=float(np.max(trajectory.constraint_residual)),
        iterations=int(np.max(trajectory.info.iterations)),
        method=Method(int(np.max(trajectory.info.method))).name,
        result=Result(int(trajectory.result)).name,
    )


def _drift_and_band(t: np.ndarray, energy: np.ndarray) -> tuple[float, float]:
    """Change over the run of the line fitted to an error of the energy, and the largest distance from it."""
    if not np.isfinite(energy).all():
        return float("nan"), float("nan")
    line = np.polynomial.Polynomial.fit(t, energy, 1)
    fitted = line(t)
    return float(fitted[-1] - fitted[0]), float(np.abs(energy - fitted).max())

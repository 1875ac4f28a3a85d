"""Observed orders: Galerkin schemes and compositions on all systems."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

import vmri_jax as vm
from benchmarks import programs
from benchmarks.measure import Tell, silent
from benchmarks.report import Report
from vmri_jax.diagnostics import fit_order
from vmri_jax.study import ReferenceSolution

COLUMNS = ("system", "scheme", "num_micro", "order", "of q", "+-", "of p", "+- ", "points", "finest error", "holds")
DEGREES, COMPOSITIONS = (1, 2, 3, 4), ("suzuki4", "kahan-li6", "kahan-li8")
TOLERANCE = 0.25
COARSEST, FLOOR, OF_MULTIPLIERS = 1e-4, 4e-13, 5
"""Relative errors between the first two are fitted; multipliers make the floor of momenta so many times higher."""
ACCUMULATED = 200
"""Round-off has doubled after so many steps."""
RATIO, POINTS = 2**0.35, 3
"""From one number of steps to the next; so many of the smallest errors above the floor are fitted."""
NODES = 5
"""Compared times, equally spaced up to t = 1: an error at one time alone may vanish by chance."""
MOST_STEPS = 20_000


@dataclass(frozen=True)
class Case:
    """One scheme on one system."""

    system: str
    label: str
    scheme: vm.Scheme | vm.Composition
    num_micro: int


def sizes(name: str) -> list[Case]:
    """ "quick": degrees 1 to 4 with 4 micro steps and compositions; "full": also 1 and 10 micro steps."""
    cases = []
    numbers = (4,) if name == "quick" else (1, 4, 10)
    for system, rule, num_micro, degree in product(("FPU l=3", "TSP", "SAM"), ("gauss", "lobatto"), numbers, DEGREES):
        scheme = vm.galerkin(num_micro, degree, rule)
        cases.append(Case(system, f"galerkin {degree}, {rule}", scheme, num_micro))
    for base, system, composition in product(("fully explicit", "explicit slow"), ("FPU l=3", "TSP"), COMPOSITIONS):
        scheme = vm.compose(programs.SCHEMES[base](5), composition)
        cases.append(Case(system, f"{base}, {composition}", scheme, 5))
    return cases


def run(cases: list[Case], name: str, tell: Tell = silent) -> Iterator[Report]:
    """Measure all of it, a report after each scheme."""
    rows = []
    for case in cases:
        tell(f"{case.system}, {case.label}, {case.num_micro}")
        rows.append(measure(case))
        good = sum(row["holds"] != "no" for row in rows)
        notes = [f"{good} of {len(rows)} orders of q and p are within {TOLERANCE} of the order expected."]
        yield Report("orders", name, rows, [], notes)


def truth(system: str) -> ReferenceSolution:
    """Positions and momenta up to t = 1, good to about 1e-14."""
    with np.load(programs.ground_truth(system, "1")) as file:
        stride = (len(file["t"]) - 1) // NODES
        q, v = file["q"][::stride], file["v"][::stride]
    return ReferenceSolution(q, programs.masses(programs.problem(system)) * v)


def measure(case: Case) -> dict:
    """Errors over ever smaller macro steps, and the slopes through the last of them."""
    problem, reference = programs.problem(case.system), truth(case.system)
    run, order = vm.prepare(problem, case.scheme, macro_dt=1.0 / NODES, num_steps=NODES), case.scheme.order
    sizes = np.array([np.abs(reference.q).max(), np.abs(reference.p).max()])
    constrained = sum(problem.system.num_constraints(problem.q_s, problem.q_f)) > 0
    floors = FLOOR * np.array([1, OF_MULTIPLIERS if constrained else 1])
    steps, errors = [], []
    n = NODES * max(1, round(100 / case.scheme.num_micro / case.scheme.degree / NODES))
    while n < MOST_STEPS and not (errors and np.all(errors[-1] < floors)):
        steps.append(n)
        errors.append(np.array(reference.errors(run(macro_dt=1.0 / n, num_steps=n, throw=False))) / sizes)
        n = max(n + NODES, NODES * round(n * RATIO / NODES))
    row = {"system": case.system, "scheme": case.label, "num_micro": case.num_micro, "order": order}
    fits = []
    for error, floor in zip(np.transpose(errors), floors, strict=True):
        above = error > floor * (1 + np.array(steps) / ACCUMULATED)
        fitted = np.flatnonzero(above & (error < COARSEST))[-POINTS:]
        if len(fitted) < 3:
            return row | {"points": len(fitted), "holds": "no"}
        fits.append(fit_order(1 / np.array(steps)[fitted], error[fitted], plateau=0.0))
    holds = all(abs(fit.order - order) <= TOLERANCE for fit in fits)
    found = {"of q": fits[0].order, "+-": fits[0].half_width, "of p": fits[1].order, "+- ": fits[1].half_width}
    finest = {"points": min(fit.points for fit in fits), "finest error": float(np.nanmin(np.array(errors)[:, 0]))}
    return row | found | finest | {"holds": "yes" if holds else "no"}

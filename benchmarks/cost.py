"""Cost of accuracy in the fast variables: time per micro step against num_micro, and against the dense solve."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import jax
import numpy as np
from matplotlib.figure import Figure

import vmri_jax as vm
from benchmarks import programs
from benchmarks.gail2014.cost import CostStudy, Curve, cost_study, plot_cost
from benchmarks.gail2014.reference import unstructured
from benchmarks.measure import Ratio, quartiles, ratio, silent
from benchmarks.programs import SCHEMES
from benchmarks.report import Claim, Report, spread
from vmri_jax.scene.ledger import temporary_bytes

TIME = "µs/micro step"
COLUMNS = ("case", "method", "num_micro", "unknowns", "micro_dt", TIME, "to cheapest", "iterations", "result")
FPU_DT, RIGID_DT = 0.001, 0.0002
"""Micro steps of chains, and of systems with constraints: a macro step of 100 of them still converges."""
ALL = (1, 4, 8, 12, 20, 40, 60, 100)
MACRO_STEPS, DENSE_MACRO_STEPS = 20, 3
"""Macro steps with the most micro steps, of the default solve and of the dense one, which is slower: all runs of a method
have the same length. With fewer steps the call counts."""
LEAST_COMPARED = 10
"""Fewest micro steps with which the default solve is held against the dense one."""

MEMORY_FROM = 100
"""Fewest micro steps whose memory counts: with fewer of them, memory that does not depend on num_micro counts as well."""


@dataclass(frozen=True)
class Case:
    """One system under one scheme, over the same simulated time for every num_micro.

    dense_num_micro: where the dense solve runs too.
    turn: the most that the largest num_micro may cost per micro step, over the cheapest.
    dense: the least that the dense solve must cost over the default one, from `LEAST_COMPARED` micro steps on.
    """

    system: str
    scheme: str
    micro_dt: float
    num_micro: tuple[int, ...]
    dense_num_micro: tuple[int, ...] = ()
    turn: float | None = None
    dense: float | None = None

    @property
    def label(self) -> str:
        """Name in tables and figures."""
        return f"{self.system}, {self.scheme}"

    def affordable(self, most_unknowns: int) -> "Case":
        """The dense solve only where it has at most this number of unknowns."""
        problem = programs.problem(self.system)
        dense = tuple(n for n in self.dense_num_micro if programs.unknowns(problem, n) <= most_unknowns)
        return replace(self, dense_num_micro=dense)

    def measure(self, repeats: int, seconds: float, tell=silent) -> CostStudy:
        """Time every program in turns, the dense solve over fewer macro steps."""
        problem = whole = programs.problem(self.system)
        if self.system.startswith("FPU") and self.scheme != "fully implicit":
            whole = unstructured(problem)  # explicit schemes solve for the whole macro step too, as the paper did
        t_end = MACRO_STEPS * max(self.num_micro) * self.micro_dt
        curves = [Curve("auto", problem, self.num_micro, t_end)]
        if self.dense_num_micro:
            t_end = DENSE_MACRO_STEPS * max(self.dense_num_micro) * self.micro_dt
            curves.append(Curve("dense", whole, self.dense_num_micro, t_end))
        how = {"micro_dt": self.micro_dt, "repeats": repeats, "min_seconds": seconds}
        study = cost_study(self.label, SCHEMES[self.scheme], curves, **how, progress=lambda what, *_: tell(what))
        jax.clear_caches()  # hundreds of programs are more memory maps than a process may have
        return study

    def rows(self, study: CostStudy) -> list[dict]:
        """Rows of a report."""
        costs = {method: study.curve(label, method)[1] for label, method in study.curves}
        cheapest = {method: np.min(cost, where=np.isfinite(cost), initial=np.inf) for method, cost in costs.items()}
        return [
            {
                "case": row.label,
                "method": row.method,
                "num_micro": row.num_micro,
                "unknowns": row.num_unknowns,
                "micro_dt": self.micro_dt,
                **spread(TIME, quartiles(row.samples)),
                "to cheapest": row.us_per_micro_step / float(cheapest[row.method]),
                "iterations": row.iterations,
                "result": row.result,
            }
            for row in study.rows
        ]

    def claims(self, study: CostStudy) -> list[Claim]:
        """The largest num_micro over the cheapest, if it ran, and the dense solve over the default one where they are closest."""
        default, dense, claims = study.samples("auto"), study.samples("dense"), []
        most = max(self.num_micro)
        if most in default and len(self.num_micro) > 1:
            what = f"{self.label}, h = {self.micro_dt:g}: num_micro {most} over the cheapest"
            cheapest = min(default.values(), key=np.median)
            claims.append(Claim(what, ratio(default[most], cheapest), at_most=self.turn))
        ratios: Mapping[int, Ratio] = {
            n: ratio(dense[n], default[n]) for n in dense if n in default and n >= LEAST_COMPARED
        }
        if ratios:
            where = f"num_micro {min(ratios)}" + (f" to {max(ratios)}, least" if len(ratios) > 1 else "")
            least = min(ratios.values(), key=lambda ratio: ratio.value)
            claims.append(Claim(f"{self.label}, {where}: dense over default", least, at_least=self.dense))
        return claims


ONCE = (
    Case("FPU l=3", "fully implicit", FPU_DT, (100,), (100,), dense=50.0),
    Case("FPU l=50", "fully implicit", FPU_DT, (30,), (30,), dense=2000.0),
    Case("SAM", "fully implicit", RIGID_DT, (50,), (50,), dense=100.0),
)
"""Single points at which the dense solve is held against the default one, however slow it is."""


@dataclass(frozen=True)
class Size:
    """How much is run.

    turning: cases in which cost must not turn up.
    once: single points against the dense solve.
    linear: cases run up to a large num_micro.
    most_unknowns: the dense solve is left out beyond.
    """

    turning: tuple[Case, ...]
    once: tuple[Case, ...]
    linear: tuple[Case, ...]
    most_unknowns: int
    repeats: int
    seconds: float


def _turning(num_micro, chains, dense_num_micro) -> tuple[Case, ...]:
    """Every system under every scheme."""
    systems = [*(f"FPU l={length}" for length in chains), "TSP", "SAM"]
    cases = []
    for system, scheme in product(systems, SCHEMES):
        chain = system.startswith("FPU")
        turn = 1.05 if chain and scheme != "fully implicit" else 1.8
        dt = FPU_DT if chain else RIGID_DT
        cases.append(Case(system, scheme, dt, num_micro, dense_num_micro, turn, 10.0))
    return tuple(cases)


def _linear(num_micro: tuple[int, ...]) -> tuple[Case, ...]:
    """One of each kind of step; micro steps so small that the largest macro step is still an ordinary one."""
    pairs = (
        ("FPU l=3", "fully implicit"),
        ("FPU l=50", "explicit slow"),
        ("TSP", "fully explicit"),
        ("SAM", "fully implicit"),
    )
    return tuple(Case(*pair, 1e-5, num_micro) for pair in pairs)


def sizes(name: str) -> Size:
    """ "quick" or "full"."""
    if name == "quick":
        return Size(_turning((1, 20, 100), (10, 200), (20,)), ONCE, _linear((10, 200, 5000)), 310, 5, 0.05)
    num_micro = (10, 50, 100, 500, 1000, 2500, 5000)
    return Size(_turning(ALL, (10, 50, 100, 200), ALL), ONCE, _linear(num_micro), 700, 9, 0.1)


def run(size: Size, name: str, tell=silent) -> Iterator[Report]:
    """Measure all of it, a report after each case."""
    rows, claims, turning = [], [], {}

    def measured(case: Case, repeats: int) -> CostStudy:
        study = case.measure(repeats, size.seconds, tell)
        rows.extend(case.rows(study))
        claims.extend(case.claims(study))
        return study

    def report() -> Report:
        title = "Computing time does not turn up"
        figures: dict[str, Callable[[], Figure]] = {}
        if turning:
            figures["cost"] = partial(plot_cost, dict(turning), title=title)
        return Report("cost", name, rows, claims, _notes(size, rows), figures)

    for case in size.turning:
        turning[case.label] = measured(case.affordable(size.most_unknowns), size.repeats)
        yield report()
    for case in size.once:
        measured(case, max(3, size.repeats // 2))
        yield report()
    for case in size.linear:
        study = case.measure(size.repeats, size.seconds, tell)
        bytes_of, more_claims = slopes(case, study)
        rows += [row | {"bytes": bytes_of.get(row["num_micro"])} for row in case.rows(study)]
        claims += more_claims
        yield report()


def slope(x, y) -> float:
    """Least-squares slope of log y against log x."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def slopes(case: Case, study: CostStudy) -> tuple[dict[int, int], list[Claim]]:
    """Temporary bytes of the macro steps of a case by num_micro, and slopes of time and bytes in logarithms."""
    samples, problem = study.samples("auto"), programs.problem(case.system)
    num_micro = np.array(list(samples))
    us = np.array(list(samples.values())) * num_micro[:, None]
    scheme = programs.SCHEMES[case.scheme]
    size = {n: _bytes(problem, scheme(n), case.micro_dt) for n in samples if n >= MEMORY_FROM}
    what = f"{case.label}: slope of log {{}} against log num_micro up to {num_micro.max():g}"
    low, high = np.quantile([slope(num_micro, sample) for sample in us.T], (0.25, 0.75))
    seen = Ratio(slope(num_micro, np.median(us, axis=1)), float(low), float(high))
    claims = [Claim(what.format("time"), seen, 1.1, 0.9)]
    if len(size) > 1:
        memory = slope(list(size), list(size.values()))
        claims.append(Claim(what.format("memory"), Ratio(memory, memory, memory), 1.1))
    return size, claims


def _bytes(problem: vm.Problem, scheme: vm.Scheme, micro_dt: float) -> int:
    """Temporary memory of one compiled macro step."""
    step = jax.jit(vm.macro_step).lower(problem.system, scheme, problem.state(), scheme.num_micro * micro_dt)
    return temporary_bytes(step.compile())


def _notes(size: Size, rows: list[dict]) -> list[str]:
    notes = [f"The dense solve was left out beyond {size.most_unknowns} unknowns, the single points aside."]
    missing = [f"{r['case']}, num_micro {r['num_micro']} ({r['result']})" for r in rows if np.isnan(r[TIME])]
    if missing:
        notes.append(f"Runs that failed and were not timed: {'; '.join(missing)}.")
    return notes

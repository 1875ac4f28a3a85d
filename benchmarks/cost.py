"""Cost of accuracy in the fast variables: time per micro step against num_micro, and against the dense solve."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

from matplotlib.figure import Figure

from benchmarks import linear
from benchmarks.curves import TIME, Case, Curves, draw, measure
from benchmarks.measure import silent
from benchmarks.programs import SCHEMES
from benchmarks.report import Claim, Report

COLUMNS = ("case", "method", "num_micro", "unknowns", "micro_dt", TIME, "to cheapest", "iterations", "result")
FPU_DT, RIGID_DT = 0.001, 0.0002
"""Micro steps of chains, and of systems with constraints: a macro step of 100 of them still converges."""
ALL = (1, 4, 8, 12, 20, 40, 60, 100)
ONCE = (
    Case("FPU l=3", "fully implicit", 0.001, (100,), (100,), dense=50.0),
    Case("FPU l=50", "fully implicit", 0.001, (30,), (30,), dense=2000.0),
    Case("SAM", "fully implicit", 0.0002, (50,), (50,), dense=100.0),
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
        case = Case(system, scheme, FPU_DT if chain else RIGID_DT, num_micro, dense_num_micro, 1.8, 10.0)
        if chain and scheme != "fully implicit":
            case = replace(case, turn=1.05)
        cases.append(case)
    return tuple(cases)


def sizes(name: str) -> Size:
    """ "quick" or "full"."""
    if name == "quick":
        return Size(
            turning=_turning((1, 20, 100), (10, 200), (20,)),
            once=ONCE,
            linear=linear.cases((10, 200, 5000)),
            most_unknowns=310,
            repeats=5,
            seconds=0.05,
        )
    chains = (10, 50, 100, 200)
    return Size(
        turning=_turning(ALL, chains, ALL),
        once=ONCE,
        linear=linear.cases((10, 50, 100, 500, 1000, 2500, 5000)),
        most_unknowns=700,
        repeats=9,
        seconds=0.1,
    )


def run(size: Size, name: str, tell=silent) -> Iterator[Report]:
    """Measure all of it, a report after each case."""
    everything: list[Curves] = []
    rows, claims, turning = [], [], []

    def report() -> Report:
        return Report("cost", name, rows, claims, _notes(size, everything), {"cost": partial(_draw, turning)})

    def add(curves: Curves) -> Curves:
        everything.append(curves)
        rows.extend(curves.rows)
        claims.extend(_claims(curves))
        return curves

    for case in size.turning:
        turning.append(add(measure(case.affordable(size.most_unknowns), size.repeats, size.seconds, tell)))
        yield report()
    for case in size.once:
        add(measure(case, max(3, size.repeats // 2), size.seconds, tell))
        yield report()
    for case in size.linear:
        more_rows, more_claims = linear.measure(case, size.repeats, size.seconds, tell)
        rows += more_rows
        claims += more_claims
        yield report()


def _draw(part: list[Curves]) -> Figure:
    dt = " and ".join(f"{h:g}" for h in dict.fromkeys(curves.case.micro_dt for curves in part))
    return draw(part, f"Computing time does not turn up (micro steps {dt})", len(SCHEMES))


def _claims(curves: Curves) -> list[Claim]:
    case, claims = curves.case, []
    turn, dense = curves.turn(), curves.dense()
    if turn is not None and len(case.num_micro) > 1:
        what = f"{case.label}, h = {case.micro_dt:g}: num_micro {max(case.num_micro)} over the cheapest"
        claims.append(Claim(what, turn, at_most=case.turn))
    if dense is not None:
        at = [n for n in case.dense_num_micro if n >= 10]
        where = f"num_micro {min(at)}" + (f" to {max(at)}, least" if len(at) > 1 else "")
        claims.append(Claim(f"{case.label}, {where}: dense over default", dense, at_least=case.dense))
    return claims


def _notes(size: Size, everything: list[Curves]) -> list[str]:
    notes = [f"The dense solve was left out beyond {size.most_unknowns} unknowns, the single points aside."]
    missing = [
        f"{row['case']}, num_micro {row['num_micro']} ({row['result']})"
        for curves in everything
        for row in curves.rows
        if math.isnan(row[TIME])
    ]
    if missing:
        notes.append(f"Runs that failed and were not timed: {'; '.join(missing)}.")
    return notes

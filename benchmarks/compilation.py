"""Cold compile and first run, each in a fresh process without a cache, and compilations over a sweep."""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from benchmarks.measure import Ratio, Tell, quartiles, ratio, silent
from benchmarks.report import Claim, Report, growing
from benchmarks.seats import Seat, Worker
from benchmarks.worker import Case

COLUMNS = ("system", "scheme", "num_micro", "first call, s", "later call, s", "start, s", "process, s", "compilations")
SYSTEMS = ("FPU l=3", "TSP", "SAM")
MICRO_DT = 1e-5
"""So small that a macro step of a thousand micro steps is an ordinary one."""
MOST_SECONDS, GROWTH = 5.0, 1.3
"""Targets: the first call at the smaller num_micro, and the larger over the smaller."""


@dataclass(frozen=True)
class Size:
    """How much is run: systems, schemes, two num_micro, processes for each."""

    systems: tuple[str, ...]
    schemes: tuple[str, ...]
    num_micro: tuple[int, ...]
    repeats: int


def sizes(name: str) -> Size:
    """ "quick" or "full"."""
    schemes = ("fully implicit", "fully explicit")
    return Size(SYSTEMS, schemes, (100, 1000), 2 if name == "quick" else 7)


def run(size: Size, name: str, tell: Tell = silent) -> Iterator[Report]:
    """Measure all of it, a report after each scheme."""
    pairs = product(size.systems, size.schemes)
    return growing("compile", name, (_measure(system, scheme, size, tell) for system, scheme in pairs))


def _measure(system: str, scheme: str, size: Size, tell: Tell) -> tuple[list[dict], list[Claim]]:
    """In processes of their own; the num_micro take turns."""
    found: dict[int, list[dict]] = {n: [] for n in size.num_micro}
    for _ in range(size.repeats):
        for n in size.num_micro:
            tell(f"{system}, {scheme}, num_micro {n}")
            words = f"{scheme.replace(' ', '_')} {n}"
            with Worker(Seat()) as worker:
                made = worker.make(Case("compile", system, words, macro_dt=n * MICRO_DT, num_steps=2))
                found[n].append(made["found"] | {"process": time.perf_counter() - worker.started})
    return [_row(system, scheme, n, found[n]) for n in size.num_micro], _claims(f"{system}, {scheme}", found)


def _row(system: str, scheme: str, num_micro: int, found: list[dict]) -> dict:
    names = {"first": "first call, s", "later": "later call, s", "start": "start, s", "process": "process, s"}
    row = {"system": system, "scheme": scheme, "num_micro": num_micro}
    row |= {name: float(np.median([one[key] for one in found])) for key, name in names.items()}
    return row | {"compilations": max(one["compilations"] for one in found)}


def _claims(label: str, found: dict[int, list[dict]]) -> list[Claim]:
    seconds = {n: [one["first"] for one in some] for n, some in found.items()}
    few, many = min(seconds), max(seconds)
    most = max(one["compilations"] for some in found.values() for one in some)
    return [
        Claim(f"{label}: seconds of the first call at num_micro {few}", quartiles(seconds[few]), MOST_SECONDS),
        Claim(f"{label}: first call at {many} over {few}", ratio(seconds[many], seconds[few]), GROWTH),
        Claim(f"{label}: compilations over a sweep of steps, parameters and starts", Ratio(most, most, most), 1.0),
    ]

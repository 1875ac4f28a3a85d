"""Single runs against hand-written C on one core, and the implicit schemes against the explicit one."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

import vmri_jax as vm
from benchmarks import c_loops, programs
from benchmarks.measure import Tell, interleaved, quartiles, ratio, silent, steps_for
from benchmarks.report import Claim, Report, growing, spread

COLUMNS = ("system", "program", "num_micro", "micro steps", "ns/micro step", "low", "high", "to C", "result")
NUM_MICRO = 10


@dataclass(frozen=True)
class Pair:
    """One system under some schemes.

    target: the most that the first scheme may take over C.
    implicit: the most that the other schemes may take over the first one.
    """

    system: str
    micro_dt: float
    num_micro: int
    schemes: tuple[str, ...]
    target: float
    implicit: float | None = None

    @property
    def label(self) -> str:
        """Name in tables and figures."""
        return f"{self.system}, num_micro {self.num_micro}"


@dataclass(frozen=True)
class Size:
    """Pairs, samples of each program, and seconds of a run."""

    pairs: tuple[Pair, ...]
    repeats: int
    seconds: float


def sizes(name: str) -> Size:
    """ "quick" or "full"; the pairs are the same."""
    explicit, every = ("fully explicit",), tuple(reversed(programs.SCHEMES))
    chains = tuple(Pair(f"FPU l={length}", 0.001, n, explicit, 2.5) for length in (3, 50, 200) for n in (NUM_MICRO, 60))
    pairs = (
        *chains,
        Pair("FPU l=10000", 0.001, NUM_MICRO, ("explicit slow",), 1 / 0.3),
        Pair("TSP", 0.0002, NUM_MICRO, every, 4.0, 3.0),
        Pair("SAM", 0.0002, NUM_MICRO, every, 8.0, 3.0),
    )
    return Size(pairs, 7, 0.1) if name == "quick" else Size(pairs, 25, 0.2)


def run(size: Size, name: str, tell: Tell = silent) -> Iterator[Report]:
    """Measure all of it, a report after each pair; without a compiler nothing is held against C."""
    return growing("floor", name, (_measure(pair, size, tell) for pair in size.pairs), c_loops.missing())


def _measure(pair: Pair, size: Size, tell: Tell) -> tuple[list[dict], list[Claim]]:
    problem = programs.problem(pair.system)
    runs, steps, results = {}, {}, {}
    for scheme in pair.schemes:
        tell(f"{pair.label}, {scheme}")
        made = programs.SCHEMES[scheme](pair.num_micro)
        simulate = programs.program(problem, made, pair.num_micro * pair.micro_dt)
        steps[scheme] = steps_for(simulate, size.seconds, 10)
        runs[scheme] = partial(simulate, steps[scheme])
        results[scheme] = vm.Result(int(np.asarray(runs[scheme]().result))).name
    first = pair.schemes[0]
    if c_loops.compiler() is not None:
        steps["C"], results["C"] = steps[first], ""
        runs["C"] = c_loops.c_loop(pair.system, problem, pair.num_micro, pair.micro_dt, steps["C"])
    timed = interleaved(runs, size.repeats)
    ns = {name: [1e9 * s / (steps[name] * pair.num_micro) for s in timed[name]] for name in runs}

    to_c = {name: ratio(sample, ns["C"]) for name, sample in ns.items()} if "C" in ns else {}
    claims = [Claim(f"{pair.label}: {first} over C", to_c[first], at_most=pair.target)] if to_c else []
    for other in pair.schemes[1:]:
        claims.append(Claim(f"{pair.label}: {other} over {first}", ratio(ns[other], ns[first]), at_most=pair.implicit))
    rows = [
        {
            "system": pair.system,
            "program": name,
            "num_micro": pair.num_micro,
            "micro_dt": pair.micro_dt,
            "micro steps": steps[name] * pair.num_micro,
            **spread("ns/micro step", quartiles(sample)),
            "to C": to_c[name].value if to_c else None,
            "result": results[name],
        }
        for name, sample in ns.items()
    ]
    return rows, claims

"""Single runs and batches against hand-written C on one core, and the implicit schemes against the explicit one."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

import vmri_jax as vm
from benchmarks import c_loops, programs
from benchmarks.measure import Tell, interleaved, quartiles, ratio, silent, steps_for
from benchmarks.report import Claim, Report, spread
from benchmarks.worker import starts

TIME = "ns/trajectory/micro step"
NUM_MICRO = 10
HELD = 256
"""The batch size that is held against C."""
MICRO_STEPS = 200_000
"""Of a whole batch in the first guess of a run's length."""


@dataclass(frozen=True)
class Case:
    """One system under some schemes, and batches of it under the fully explicit one.

    target: the most that the first scheme may take over C.
    implicit: the most that the other schemes may take over the first one.
    batches: numbers of starts.
    in_batch: the most that a trajectory in a batch of HELD may take over C.
    """

    system: str
    micro_dt: float
    num_micro: int
    schemes: tuple[str, ...]
    target: float
    implicit: float | None = None
    batches: tuple[int, ...] = ()
    in_batch: float | None = None

    @property
    def label(self) -> str:
        """Name in tables and figures."""
        return f"{self.system}, num_micro {self.num_micro}"


@dataclass(frozen=True)
class Size:
    """Cases, samples of each program, and seconds of a run."""

    cases: tuple[Case, ...]
    repeats: int
    seconds: float


def sizes(name: str) -> Size:
    """ "quick" or "full"."""
    quick = name == "quick"
    explicit, every = ("fully explicit",), tuple(reversed(programs.SCHEMES))
    batches = (1, 32, HELD) if quick else (1, 4, 16, 64, HELD, 1024)
    chosen = (
        Case("FPU l=3", 0.001, NUM_MICRO, explicit, 2.5, batches=batches, in_batch=0.6),
        *(Case(f"FPU l={length}", 0.001, NUM_MICRO, explicit, 2.5) for length in (50, 200)),
        *(Case(f"FPU l={length}", 0.001, 60, explicit, 2.5) for length in (3, 50, 200)),
        Case("FPU l=10000", 0.001, NUM_MICRO, ("explicit slow",), 1 / 0.3),
        Case("TSP", 0.0002, NUM_MICRO, every, 4.0, 3.0, batches, 0.7),
        Case("SAM", 0.0002, NUM_MICRO, every, 8.0, 3.0, batches, 0.7),
    )
    return Size(chosen, 7, 0.1) if quick else Size(chosen, 25, 0.2)


def run(size: Size, name: str, tell: Tell = silent) -> Iterator[Report]:
    """Measure all of it, a report after each case; without a compiler nothing is held against C."""
    report = Report("floor", name, notes=c_loops.missing())
    for case in size.cases:
        _measure(case, size, report, tell)
        yield report


def _measure(case: Case, size: Size, report: Report, tell: Tell) -> None:
    """Single runs, batches and the C loop in turns."""
    problem = programs.problem(case.system)
    runs, work, results = {}, {}, {}

    def add(program: str, simulate, steps: int, lanes: int = 1) -> None:
        runs[program], work[program] = partial(simulate, steps), lanes * steps * case.num_micro
        results[program] = vm.Result(int(np.max(runs[program]().result))).name

    for scheme in case.schemes:
        tell(f"{case.label}, {scheme}")
        simulate = programs.program(problem, programs.SCHEMES[scheme](case.num_micro), case.num_micro * case.micro_dt)
        add(scheme, simulate, steps_for(simulate, size.seconds, 10))
    for lanes in case.batches:
        tell(f"{case.label}, batch of {lanes}")
        add(f"batch of {lanes}", *_batch(problem, case, lanes, size.seconds), lanes)
    if c_loops.compiler() is not None:
        loop = partial(c_loops.c_loop, case.system, problem, case.num_micro, case.micro_dt)
        steps = steps_for(lambda n: loop(n)(), size.seconds, 10)
        runs["C"], work["C"] = loop(steps), steps * case.num_micro
    timed = interleaved(runs, size.repeats)
    ns = {program: [1e9 * s / work[program] for s in timed[program]] for program in runs}

    to_c = {program: ratio(sample, ns["C"]) for program, sample in ns.items()} if "C" in ns else {}
    first, *others = case.schemes
    for program, most in ((first, case.target), (f"batch of {HELD}", case.in_batch)):
        if program in to_c and most is not None:
            report.claims.append(Claim(f"{case.label}: {program} over C", to_c[program], at_most=most))
    for other in others:
        over_first = ratio(ns[other], ns[first])
        report.claims.append(Claim(f"{case.label}: {other} over {first}", over_first, at_most=case.implicit))
    for program, sample in ns.items():
        row = {"system": case.system, "program": program, "num_micro": case.num_micro, "micro_dt": case.micro_dt}
        row |= spread(TIME, quartiles(sample)) | {"to C": to_c[program].value if to_c else None}
        report.rows.append(row | {"result": results.get(program, "")})


def _batch(problem: vm.Problem, case: Case, lanes: int, seconds: float):
    """``simulate(num_steps)``, and macro steps that last about long enough; few numbers are tried, since a batch is
    compiled for each."""
    states, scheme = starts(problem, lanes), vm.fully_explicit(case.num_micro)

    def simulate(num_steps: int) -> vm.Trajectory:
        steps = {"macro_dt": case.num_micro * case.micro_dt, "num_steps": num_steps, "save": num_steps}
        return vm.simulate_batch(problem.system, scheme, states, **steps)

    steps = max(1, MICRO_STEPS // (lanes * case.num_micro))
    (taken,) = interleaved({"": partial(simulate, steps)}, 1, 0.0)[""]
    return simulate, steps if taken > seconds / 4 else round(steps * seconds / taken)

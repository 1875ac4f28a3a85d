"""Batches: time per trajectory and micro step against the batch size, and against one run of the C loop."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

import vmri_jax as vm
from benchmarks import c_loops, programs
from benchmarks.measure import Tell, interleaved, quartiles, ratio, silent, steps_for
from benchmarks.peers import cases, ours
from benchmarks.peers.compare import OURS, batch_case
from benchmarks.peers.scan import candidates, scan
from benchmarks.report import Claim, Report, growing, spread
from benchmarks.worker import starts

TIME = "ns/trajectory/micro step"
COLUMNS = ("system", "program", "batch", TIME, "low", "high", "to C", "iterations", "result")
NUM_MICRO = 10
HELD = 256
"""The batch size that is held against C."""
DEGREE = 8
"""Of the Lobatto scheme that is held against C at the same accuracy."""


@dataclass(frozen=True)
class Case:
    """One system under the fully explicit scheme.

    target: the most that a trajectory in a batch of HELD may take over C.
    as_accurate: the problem of `benchmarks.peers.cases` on which a batch of any step and order has to reach C's error.
    """

    system: str
    micro_dt: float
    target: float
    as_accurate: str | None = None


@dataclass(frozen=True)
class Size:
    """How much is run; micro_steps are those of a whole batch in the first guess of a run's length."""

    cases: tuple[Case, ...]
    batches: tuple[int, ...]
    repeats: int
    seconds: float
    micro_steps: int = 200_000


def sizes(name: str) -> Size:
    """ "quick" or "full"."""
    chosen = (
        Case("FPU l=3", 0.001, 0.6),
        Case("TSP", 0.0002, 0.7, "TSP t=1"),
        Case("SAM", 0.0002, 0.7, "SAM t=1"),
    )
    if name == "quick":
        return Size(chosen, (1, 32, 256), 5, 0.05)
    return Size(chosen, (1, 4, 16, 64, 256, 1024), 15, 0.2)


def run(size: Size, name: str, tell: Tell = silent) -> Iterator[Report]:
    """Measure all of it, a report after each case."""
    return growing("batch", name, (_measure(case, size, tell) for case in size.cases), c_loops.missing())


def _program(problem: vm.Problem, case: Case, batch: int) -> Callable:
    states = starts(problem, batch)

    def run(num_steps: int) -> vm.Trajectory:
        return vm.simulate_batch(
            problem.system,
            vm.fully_explicit(NUM_MICRO),
            states,
            macro_dt=NUM_MICRO * case.micro_dt,
            num_steps=num_steps,
            save=num_steps,
        )

    return run


def _measure(case: Case, size: Size, tell: Tell) -> tuple[list[dict], list[Claim]]:
    """All batch sizes, and a batch as accurate as C."""
    rows, claims = _all_sizes(case, size, tell)
    if case.as_accurate and c_loops.compiler() is not None:
        row, claim = _as_accurate(case, case.as_accurate, size, tell)
        rows.append(row)
        claims.append(claim)
    return rows, claims


def _all_sizes(case: Case, size: Size, tell: Tell) -> tuple[list[dict], list[Claim]]:
    problem = programs.problem(case.system)
    runs, work, results = {}, {}, {}
    for batch in size.batches:
        tell(f"{case.system}, batch {batch}")
        simulate = _program(problem, case, batch)
        steps = _steps(simulate, batch, size)
        key = f"default {batch}"
        runs[key], work[key] = partial(simulate, steps), batch * steps * NUM_MICRO
        results[key] = runs[key]()
    if c_loops.compiler() is not None:
        loop = partial(c_loops.c_loop, case.system, problem, NUM_MICRO, case.micro_dt)
        steps = steps_for(lambda n: loop(n)(), size.seconds, 10)
        runs["C"], work["C"] = loop(steps), steps * NUM_MICRO
    timed = interleaved(runs, size.repeats)
    ns = {key: [1e9 * s / work[key] for s in timed[key]] for key in runs}

    rows, claims = [], []
    for key, sample in ns.items():
        program, _, batch = key.partition(" ")
        run = results.get(key)
        to_c = ratio(sample, ns["C"]) if "C" in ns else None
        rows.append(
            {
                "system": case.system,
                "program": program,
                "batch": int(batch or 1),
                "micro_dt": case.micro_dt,
                **spread(TIME, quartiles(sample)),
                "to C": to_c and to_c.value,
                "iterations": int(np.max(run.info.iterations)) if run else None,
                "result": vm.Result(int(np.max(run.result))).name if run else "",
            }
        )
        if to_c and key != "C" and int(batch) == HELD:
            claims.append(Claim(f"{case.system}, batch of {HELD}: over C", to_c, at_most=case.target))
    return rows, claims


def _as_accurate(case: Case, problem: str, size: Size, tell: Tell) -> tuple[dict, Claim]:
    """One trajectory of a batch that is as accurate as C, by the cheapest setting of a scheme of high degree."""
    tell(f"{case.system}, as accurate as C")
    single, (truth, lanes) = cases.case(problem), batch_case(problem, HELD)
    steps = round(single.t_end / case.micro_dt)
    loop = c_loops.c_loop(case.system, single.problem, NUM_MICRO, case.micro_dt, steps // NUM_MICRO)
    error = single.error(np.concatenate(loop()[:2]))
    ladders = ours.batch_ladders(truth, *lanes, schemes={f"Lobatto {DEGREE}": vm.galerkin(1, DEGREE, "lobatto")})
    found = candidates(scan(OURS, ladders, truth, 1.0, (error,)), error)
    timed = interleaved({point.label: point.run for point in found} | {"C": loop}, size.repeats)
    best = min(found, key=lambda point: np.median(timed[point.label]))
    per_lane = [s / HELD for s in timed[best.label]]
    to_c = ratio(per_lane, timed["C"])
    row = {"system": case.system, "program": "as accurate as C", "batch": HELD, "micro_dt": case.micro_dt}
    row |= spread(TIME, quartiles(per_lane, 1e9 / steps)) | {"to C": to_c.value, "iterations": None}
    row |= {"result": best.label, "error": best.error, "error of C": error}
    what = f"{case.system}, batch of {HELD}, as accurate as C (error {error:.0e}): over C"
    return row, Claim(what, to_c, at_most=case.target)


def _steps(simulate: Callable, batch: int, size: Size) -> int:
    """Macro steps that last about long enough; few numbers are tried, since a batch is compiled for each."""
    steps = max(1, size.micro_steps // (batch * NUM_MICRO))
    (seconds,) = interleaved({"": partial(simulate, steps)}, 1, 0.0)[""]
    return steps if seconds > size.seconds / 4 else round(steps * size.seconds / seconds)

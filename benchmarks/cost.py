"""Linear in the number of micro steps: time and memory of a macro step with 10 to 5000 of them, at a constant micro
step."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import jax
import numpy as np

import vmri_jax as vm
from benchmarks import programs
from benchmarks.gail2014.cost import Curve, cost_study
from benchmarks.measure import Ratio, Tell, exactly, quartiles, silent, temporary_bytes
from benchmarks.report import Claim, Report, spread

MICRO_DT = 1e-5
"""So small that the largest macro step is still an ordinary one."""
MACRO_STEPS = 20
"""Macro steps with the most micro steps; all runs of a system have the same length.

With fewer steps the call counts.
"""
MEMORY_FROM = 100
"""Fewest micro steps whose memory counts: with fewer of them, memory that does not depend on num_micro counts as
well."""
CASES = (
    ("FPU l=3", "fully implicit"),
    ("FPU l=50", "explicit slow"),
    ("TSP", "fully explicit"),
    ("SAM", "fully implicit"),
)
"""Systems and schemes: one of each kind of step."""


@dataclass(frozen=True)
class Size:
    """Systems and schemes, numbers of micro steps, samples of a time and seconds of a sample."""

    cases: Sequence[tuple[str, str]]
    num_micro: tuple[int, ...]
    repeats: int
    seconds: float


def sizes(name: str) -> Size:
    """ "quick" or "full"."""
    if name == "quick":
        return Size(CASES, (10, 200, 5000), 5, 0.05)
    return Size(CASES, (10, 50, 100, 500, 1000, 2500, 5000), 9, 0.1)


def run(size: Size, name: str, tell: Tell = silent) -> Iterator[Report]:
    """A report after each case."""
    report = Report("cost", name)
    for system, scheme in size.cases:
        label, problem, made = f"{system}, {scheme}", programs.problem(system), programs.SCHEMES[scheme]
        curve = Curve("auto", problem, size.num_micro, MACRO_STEPS * max(size.num_micro) * MICRO_DT)
        how = {"micro_dt": MICRO_DT, "repeats": size.repeats, "min_seconds": size.seconds}
        study = cost_study(label, made, [curve], **how, progress=lambda what, *_: tell(what))
        jax.clear_caches()  # hundreds of programs are more memory maps than a process may have
        memory = {n: _bytes(problem, made(n)) for n in size.num_micro if n >= MEMORY_FROM}
        for row in study.rows:
            shown = {"case": label, "num_micro": row.num_micro, **spread("µs/micro step", quartiles(row.samples))}
            shown |= {"iterations": row.iterations, "result": row.result, "bytes": memory.get(row.num_micro)}
            report.rows.append(shown)
        report.claims.extend(_slopes(label, study.samples("auto"), memory))
        yield report


def slope(x, y) -> float:
    """Least-squares slope of log y against log x."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def _slopes(label: str, samples: Mapping[int, Sequence[float]], memory: Mapping[int, int]) -> Iterator[Claim]:
    """Slopes of time and of bytes in logarithms, over the runs that succeeded."""
    what = f"{label}: slope of log {{}} against log num_micro"
    if len(samples) > 1:
        num_micro = np.array(list(samples))
        us = np.array(list(samples.values())) * num_micro[:, None]  # of a macro step
        low, high = np.quantile([slope(num_micro, sample) for sample in us.T], (0.25, 0.75))
        seen = Ratio(slope(num_micro, np.median(us, axis=1)), float(low), float(high))
        yield Claim(what.format("time"), seen, 1.1, 0.9)
    if len(memory) > 1:
        yield Claim(what.format("memory"), exactly(slope(list(memory), list(memory.values()))), 1.1)


def _bytes(problem: vm.Problem, scheme: vm.Scheme) -> int:
    """Temporary memory of one compiled macro step."""
    step = jax.jit(vm.macro_step).lower(problem.system, scheme, problem.state(), scheme.num_micro * MICRO_DT)
    return temporary_bytes(step.compile())

"""Linear in num_micro: time and temporary memory of one macro step up to thousands of micro steps."""

import jax
import numpy as np

import vmri_jax as vm
from benchmarks import curves, programs
from benchmarks.curves import Case
from benchmarks.measure import Ratio, Tell, silent
from benchmarks.report import Claim

MEMORY_FROM = 100
"""Below so many micro steps what does not depend on num_micro counts as well."""


def slope(x, y) -> float:
    """Least-squares slope of log y against log x."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def cases(num_micro: tuple[int, ...]) -> tuple[Case, ...]:
    """One of each kind of step; micro steps so small that the largest macro step is still an ordinary one."""
    return (
        Case("FPU l=3", "fully implicit", 1e-5, num_micro),
        Case("FPU l=50", "explicit slow", 1e-5, num_micro),
        Case("TSP", "fully explicit", 1e-5, num_micro),
        Case("SAM", "fully implicit", 1e-5, num_micro),
    )


def measure(case: Case, repeats: int, seconds: float, tell: Tell = silent) -> tuple[list[dict], list[Claim]]:
    """Time and temporary memory of the macro steps of a case: rows, and slopes in logarithms."""
    found = curves.measure(case, repeats, seconds, tell)
    problem = programs.problem(case.system)
    num_micro, _ = found.curve("auto")
    many = num_micro[num_micro >= MEMORY_FROM]
    size = {int(n): temporary_bytes(problem, programs.SCHEMES[case.scheme](int(n)), case.micro_dt) for n in many}
    us = np.array([found.samples["auto", int(n)] for n in num_micro]) * num_micro[:, None]
    rows = [row | {"bytes": size.get(row["num_micro"])} for row in found.rows]

    what = f"{case.label}: slope of log {{}} against log num_micro up to {num_micro.max():g}"
    low, high = np.quantile([slope(num_micro, sample) for sample in us.T], (0.25, 0.75))
    seen = Ratio(slope(num_micro, np.median(us, axis=1)), float(low), float(high))
    claims = [Claim(what.format("time"), seen, 1.1, 0.9)]
    if many.size > 1:
        memory = slope(many, list(size.values()))
        claims.append(Claim(what.format("memory"), Ratio(memory, memory, memory), 1.1))
    return rows, claims


def temporary_bytes(problem: vm.Problem, scheme: vm.Scheme, micro_dt: float) -> int:
    """Temporary memory of one compiled macro step."""
    step = jax.jit(vm.macro_step)
    compiled = step.lower(problem.system, scheme, problem.state(), scheme.num_micro * micro_dt).compile()
    return compiled.memory_analysis().temp_size_in_bytes  # pyright: ignore[reportOptionalMemberAccess]

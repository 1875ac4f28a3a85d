"""Linear in num_micro: time and temporary memory of one macro step up to thousands of micro steps."""

from typing import Any

import jax
import numpy as np

import vmri_jax as vm
from benchmarks import programs
from benchmarks.gail2014.cost import CostStudy
from benchmarks.measure import Ratio
from benchmarks.report import Claim
from vmri_jax.scene.ledger import temporary_bytes

MEMORY_FROM = 100
"""Fewest micro steps whose memory counts: with fewer of them, memory that does not depend on num_micro counts as well."""


def slope(x, y) -> float:
    """Least-squares slope of log y against log x."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def slopes(case: Any, study: CostStudy) -> tuple[dict[int, int], list[Claim]]:
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

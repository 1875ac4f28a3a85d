"""Fair comparison of run times: programs take turns, and what is reported is a ratio with its spread."""

import os
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import jax
import numpy as np

MIN_SECONDS = 0.02
"""A sample shorter than this is made of several calls; longer than clocks and schedulers disturb."""

Tell = Callable[[str], None]
"""Told what is about to be measured."""


def silent(_: str) -> None:
    """Say nothing."""


@dataclass(frozen=True)
class Ratio:
    """A ratio of two times: of their medians, and the quartiles of the ratios of samples taken in turn."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3g} ({self.low:.3g} to {self.high:.3g})"

    @property
    def inverse(self) -> "Ratio":
        """The other way around."""
        return Ratio(1 / self.value, 1 / self.high, 1 / self.low)


def ratio(above: Sequence[float], below: Sequence[float]) -> Ratio:
    """`above` over `below`, two lists of samples from one `interleaved`.

    Raises:
        ValueError: lists of different lengths, or empty ones.
    """
    if len(above) != len(below) or not len(above):
        raise ValueError(f"ratio: {len(above)} samples over {len(below)}; both must come from one `interleaved`.")
    low, high = np.quantile(np.divide(above, below), (0.25, 0.75))
    return Ratio(float(np.median(above) / np.median(below)), float(low), float(high))


def interleaved(
    runs: Mapping[str, Callable[[], object]],
    repeats: int,
    min_seconds: float = MIN_SECONDS,
    tell: Tell = silent,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, list[float]]:
    """Seconds per call of every run, `repeats` samples each, after one call that is not counted.

    The runs take turns, and every round starts with another one, so that a slow moment of the machine, or what the run
    before left in the caches, hits all of them alike.

    Args:
        runs: callables by name; what they return is waited for (`jax.block_until_ready`).
        repeats: samples of each.
        min_seconds: a sample is the mean of as many calls as take about so long.
        tell: told the name of each run before its first call.
        clock: `time.process_time` where other processes share the core.
    """
    calls, seconds = {}, {name: [] for name in runs}
    for name, run in runs.items():
        tell(name)
        _seconds(run, 1, clock)
        calls[name] = max(1, round(min_seconds / _seconds(run, 1, clock)))
    names = list(runs)
    for i in range(repeats):
        start = i % max(1, len(names))
        for name in names[start:] + names[:start]:
            seconds[name].append(_seconds(runs[name], calls[name], clock))
    return seconds


def steps_for(run: Callable[[int], object], seconds: float, unit: int = 1, most: int = 10**9) -> int:
    """A multiple of `unit`, at most `most`, for which ``run(steps)`` takes about `seconds`.

    The first call, which compiles, is not counted; and so is what a call costs besides its steps.
    """
    steps = unit
    jax.block_until_ready(run(steps))
    none = _seconds(lambda: run(unit), 2)
    while True:
        taken = _seconds(lambda n=steps: run(n), 1)
        if (taken >= seconds / 8 and taken > 3 * none) or taken >= seconds or steps * 4 > most:
            break
        steps *= 4
    return max(1, min(round(steps * seconds / taken), most) // unit) * unit


def _seconds(run: Callable[[], object], calls: int, clock: Callable[[], float] = time.perf_counter) -> float:
    start = clock()
    for _ in range(calls):
        jax.block_until_ready(run())
    return (clock() - start) / calls


def machine() -> dict:
    """Versions, processor, cores of this process and compiler flags, for every file of results."""
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None
    return {
        "processor": processor(),
        "cores": cores,
        "system": platform.platform(),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "jaxlib": version("jaxlib"),
        "numpy": np.__version__,
        "vmri_jax": version("vmri_jax"),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
    }


def processor() -> str:
    """Name of the processor."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())

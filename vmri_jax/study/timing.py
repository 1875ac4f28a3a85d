"""Reports of run times: ratios with their spread, and the machine on which they were measured."""

import os
import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import jax
import numpy as np

from vmri_jax.running.timing import MIN_SECONDS, Tell, interleaved, seconds_per_call, silent

__all__ = ["MIN_SECONDS", "Ratio", "Tell", "interleaved", "machine", "processor", "ratio", "silent", "steps_for"]


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
        """The ratio of the second time to the first."""
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


def steps_for(run: Callable[[int], object], seconds: float, unit: int = 1, most: int = 10**9) -> int:
    """A multiple of `unit`, at most `most`, for which ``run(steps)`` takes about `seconds`.

    The first call, which compiles, is not counted. Steps are added until the time of a call is several times the time of a
    call with `unit` steps, so that the fixed cost of a call does not count either.
    """
    steps = unit
    jax.block_until_ready(run(steps))
    shortest = seconds_per_call(lambda: run(unit), 2)
    while True:
        taken = seconds_per_call(lambda n=steps: run(n), 1)
        if (taken >= seconds / 8 and taken > 3 * shortest) or taken >= seconds or steps * 4 > most:
            break
        steps *= 4
    return max(1, min(round(steps * seconds / taken), most) // unit) * unit


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

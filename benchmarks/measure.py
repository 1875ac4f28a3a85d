"""Before anything is measured: the process keeps to one core, and JAX is told how to compile.

Ratios of times with their spread.
"""

import os
import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version

import jax
import numpy as np

from vmri_jax.configure import cache_folder, configure
from vmri_jax.running.timing import interleaved, seconds_per_call
from vmri_jax.study.html import processor

__all__ = [
    "Ratio",
    "Tell",
    "exactly",
    "interleaved",
    "machine",
    "pin",
    "prepare",
    "quartiles",
    "ratio",
    "silent",
    "steps_for",
]

Tell = Callable[[str], None]
"""Called with the name of a run before it is measured."""


def silent(_: str) -> None:
    """A `Tell` that prints nothing."""


@dataclass(frozen=True)
class Ratio:
    """A ratio of two times: of their medians, and the quartiles of the ratios of samples taken in turn."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3g} ({self.low:.3g} to {self.high:.3g})"


def exactly(value: float) -> Ratio:
    """A ratio that was measured once."""
    return Ratio(value, value, value)


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

    The first call, which compiles, is not counted. Steps are added until the time of a call is several times the time
    of a call with `unit` steps, so that the fixed cost of a call does not count either.
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


def quartiles(samples: Sequence[float], scale: float = 1.0) -> Ratio:
    """Median and quartiles of samples, times `scale`."""
    low, middle, high = (scale * float(x) for x in np.quantile(samples, (0.25, 0.5, 0.75)))
    return Ratio(middle, low, high)


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


def pin(core: int | None) -> int | None:
    """Keep this process to one core, by default the last one it may use; a negative one leaves it free: None."""
    if not hasattr(os, "sched_setaffinity") or (core is not None and core < 0):
        return None
    allowed = os.sched_getaffinity(0)
    core = max(allowed) if core is None else core
    if core not in allowed:
        raise ValueError(f"core {core} is not one this process may use; choose from {sorted(allowed)}.")
    os.sched_setaffinity(0, {core})
    return core


def prepare(core: int | None = -1, cache: bool = True) -> None:
    """Before JAX starts: keep to one core, set the compiler's flags and its cache, switch 64-bit floats on."""
    pin(core)
    configure(cache=cache_folder() if cache else None)


def temporary_bytes(program: jax.stages.Compiled) -> int:
    """Memory that a compiled program needs besides what goes in and out."""
    analysis = program.memory_analysis()
    assert analysis is not None
    return analysis.temp_size_in_bytes

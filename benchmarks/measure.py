"""Before anything is measured: the process keeps to one core, and JAX is told how to compile."""

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from vmri_jax.configure import cache_folder, configure
from vmri_jax.study.timing import Ratio, Tell, interleaved, machine, ratio, silent, steps_for

__all__ = [
    "Ratio",
    "Size",
    "Tell",
    "interleaved",
    "machine",
    "pin",
    "prepare",
    "quartiles",
    "ratio",
    "silent",
    "steps_for",
]


Case = TypeVar("Case")


@dataclass(frozen=True)
class Size(Generic[Case]):
    """The cases of a benchmark, and the clock of its times.

    shared: other processes share the core, so that times are processor times, not wall times.
    """

    cases: list[Case]
    shared: bool = False

    @property
    def clock(self) -> Callable[[], float]:
        """The clock, in seconds."""
        return time.process_time if self.shared else time.perf_counter

    @property
    def clock_name(self) -> str:
        """The kind of times, for reports."""
        return "processor time" if self.shared else "wall time"


def quartiles(samples: Sequence[float], scale: float = 1.0) -> Ratio:
    """Median and quartiles of samples, times `scale`."""
    low, middle, high = (scale * float(x) for x in np.quantile(samples, (0.25, 0.5, 0.75)))
    return Ratio(middle, low, high)


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


def prepare(core: int | None = -1, cache: bool = True, devices: int = 1) -> None:
    """Before JAX starts: keep to one core, set the compiler's flags and its cache, switch 64-bit floats on."""
    pin(core)
    configure(devices=devices if devices > 1 else None, cache=cache_folder() if cache else None)

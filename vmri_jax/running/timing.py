"""Fair comparison of run times: programs take turns."""

import time
from collections.abc import Callable, Mapping, Sequence

import jax
import numpy as np

MIN_SECONDS = 0.02
"""Least seconds of a sample; shorter runs are called several times. It is long against the resolution of clocks and the
time slices of schedulers; a larger value makes measurements take longer."""
LEAST_SECONDS = 1e-7
"""Seconds of a call that is too short for the clock, or only waits; a smaller value repeats calls that wait for
minutes."""


def interleaved(
    runs: Mapping[str, Callable[[], object]],
    repeats: int,
    min_seconds: float = MIN_SECONDS,
) -> dict[str, list[float]]:
    """Seconds per call of every run by a `stopwatch`, `repeats` samples each, after one call that is not counted.

    The runs take turns, and every round starts with another run, so that a slow moment of the machine, or the caches as
    the previous run left them, affect all runs alike. A sample is the mean of the calls in `min_seconds`.
    """
    calls, seconds = {}, {name: [] for name in runs}
    for name, run in runs.items():
        seconds_per_call(run, 1)
        calls[name] = max(1, round(min_seconds / max(seconds_per_call(run, 1), LEAST_SECONDS)))
    names = list(runs)
    for i in range(repeats):
        start = i % max(1, len(names))
        for name in names[start:] + names[:start]:
            seconds[name].append(seconds_per_call(runs[name], calls[name]))
    return seconds


def seconds_per_call(run: Callable[[], object], calls: int) -> float:
    """Mean seconds of `calls` calls by a `stopwatch`, up to the moment when their results are ready."""
    elapsed = stopwatch()
    for _ in range(calls):
        jax.block_until_ready(run())
    return elapsed() / calls


def stopwatch() -> Callable[[], float]:
    """Start a clock: a function that returns the seconds since this call.

    On a CPU they are the lesser of wall time, which other programs lengthen, and of processor time, which the threads
    of the work itself lengthen: a busy machine then has the same time for the work as an idle one.
    """
    clocks = (time.perf_counter, time.process_time) if jax.default_backend() == "cpu" else (time.perf_counter,)
    before = [clock() for clock in clocks]
    return lambda: min(clock() - start for clock, start in zip(clocks, before, strict=True))


def least_seconds(runs: Sequence[Callable[[], object]], samples: int) -> list[float]:
    """Estimated seconds of every run on an idle machine: the least of `samples` samples by a `stopwatch`, taken in
    turns."""
    least = [float("inf")] * len(runs)
    for i in [*range(len(runs))] * samples:
        least[i] = min(least[i], seconds_per_call(runs[i], 1))
    return least


def seconds_each(function: Callable, q, count: int = 2000) -> float:
    """Seconds per evaluation of ``function(q)``, shaped like q, in a compiled loop, each from the previous one."""

    @jax.jit
    def loop(q, zero):  # an argument, since XLA would remove the function behind a constant zero
        return jax.lax.fori_loop(0, count, lambda _, q: q + zero * function(q), q)

    seconds = interleaved({"": lambda: loop(q, 0.0)}, 3, 0.005)[""]
    return float(np.median(seconds)) / count

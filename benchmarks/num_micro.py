"""Cost of the arrowhead solver against num_micro: time per micro step, memory of the compiled step."""

import platform
import statistics
import time

import jax
import jax.numpy as jnp
from rich.progress import track

import vmri_jax as vm

CASES = (
    ("FPU l=3", vm.systems.fermi_pasta_ulam, 0.001, 4000),
    ("FPU l=3", vm.systems.fermi_pasta_ulam, 0.0001, 4000),
    ("SAM", vm.systems.simple_atomic_model, 0.0002, 1000),
    ("SAM", vm.systems.simple_atomic_model, 0.0001, 1000),
)
NUM_MICRO = (1, 10, 100, 1000)


def measure(repeats: int) -> list[dict]:
    """One row per system, micro step and num_micro; repeats interleaved over num_micro."""
    rows = []
    for name, problem, micro_dt, micro_steps in track(CASES, description="num_micro"):
        p = problem()
        runs = {n: _run(p, n, micro_dt, micro_steps) for n in NUM_MICRO}
        iterations = {n: float(jnp.mean(run().info.iterations)) for n, run in runs.items()}
        seconds = {n: [] for n in NUM_MICRO}
        for _ in range(repeats):
            for n, run in runs.items():
                start = time.perf_counter()
                jax.block_until_ready(run())
                seconds[n].append(time.perf_counter() - start)
        us = {n: statistics.median(s) / micro_steps * 1e6 for n, s in seconds.items()}
        for n in NUM_MICRO:
            rows.append(
                {
                    "system": name,
                    "micro_dt": micro_dt,
                    "num_micro": n,
                    "us/micro step": us[n],
                    "to 10": us[n] / us[10],
                    "iterations": iterations[n],
                    "to 10 per iteration": us[n] / us[10] * iterations[10] / iterations[n],
                    "spread": (max(seconds[n]) - min(seconds[n])) / statistics.median(seconds[n]),
                    "bytes": temporary_bytes(p, n, micro_dt),
                }
            )
    return rows


def _run(problem, n, micro_dt, micro_steps):
    state, scheme, steps = problem.state(), vm.fully_implicit(n), micro_steps // n
    return lambda: vm.simulate(problem.system, scheme, state, micro_dt=micro_dt, num_steps=steps)


def temporary_bytes(problem, n: int, micro_dt: float) -> int:
    """Temporary memory of one compiled macro step."""
    step = jax.jit(vm.macro_step)
    compiled = step.lower(problem.system, vm.fully_implicit(n), problem.state(), n * micro_dt).compile()
    return compiled.memory_analysis().temp_size_in_bytes  # pyright: ignore[reportOptionalMemberAccess]


def machine() -> dict:
    """Versions and processor, for the footer of every result."""
    return {
        "python": platform.python_version(),
        "jax": jax.__version__,
        "vmri_jax": "0.1.0",
        "processor": platform.processor() or platform.machine(),
        "system": platform.platform(),
    }

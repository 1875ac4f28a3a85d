"""Settings under which programs are traced and compiled in less time: tests compile for minutes and run for seconds."""

import ctypes
import gc
import os

import jax

SKIPPED_PASSES = ("while-loop-invariant-code-motion", "simplify-while-loops")
"""Passes of XLA over loops that take up to a quarter of the time to compile; without them a loop computes the same, and
slower."""
QUICK_FLAGS = ("--xla_cpu_use_fusion_emitters=false", "--xla_cpu_parallel_codegen_split_count=1")
"""Kernels are written in LLVM's language at once, not by the dozens of MLIR passes of the newer emitters; in one
module, where several are copied and split. With LLVM's optimisations and `SKIPPED_PASSES` off, half the time to
compile."""
OBJECTS_UNTIL_COLLECTION = 50_000
"""Objects that Python makes between collections of the youngest generation, 700 by default. Tracing makes many that
live; with 700 Python looks through them again and again, 8 % of the time to trace. A larger value keeps garbage for
longer."""


def unoptimised() -> None:
    """Compile without LLVM's optimisations and with `QUICK_FLAGS`, in this process and in those that it starts."""
    from vmri_jax.configure import FAST_LOOPS  # not before conftest.py has chosen the kernels

    (skipped,) = (flag for flag in FAST_LOOPS if flag.startswith("--xla_disable_hlo_passes"))
    flags = os.environ.get("XLA_FLAGS", "").split()  # a worker has those of its parent
    wanted = *QUICK_FLAGS, ",".join([skipped, *SKIPPED_PASSES])
    os.environ["XLA_FLAGS"] = " ".join([*flags, *(flag for flag in wanted if flag not in flags)])
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "1"  # workers round as this process does
    jax.config.update("jax_disable_most_optimizations", True)


def trace_quickly() -> None:
    """Fewer collections of garbage, none of what exists already; no places in Python's code in programs that nobody
    reads."""
    gc.set_threshold(OBJECTS_UNTIL_COLLECTION, 20, 20)
    gc.freeze()
    jax.config.update("jax_traceback_in_locations_limit", 0)


def forget_programs() -> None:
    """Forget compiled programs, and give their memory back to the machine; else the process stays as large as it
    was."""
    jax.clear_caches()
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # of glibc
    if trim is not None:
        trim(0)

"""How JAX compiles and runs: settings that have to be made before it starts.

The library never calls `configure` by itself. The command line and the benchmarks do; in a program of your own call it
first, before anything is computed:

    from vmri_jax import runtime
    runtime.configure()
"""

import os
from pathlib import Path

import jax

FAST_LOOPS = (
    "--xla_backend_extra_options="
    "xla_cpu_small_while_loop_byte_threshold=100000000,-memdep-block-scan-limit=10000,-unroll-threshold=200"
)
"""An option of XLA and two of LLVM: how far back a load is traced to the store it could be replaced by, and how large a loop may be
to be written out, which is done before what is left of it is turned into vector operations."""
KNOWN = jax.__version_info__[:2] == (0, 10)
"""Whether this is the version of JAX that options were tried with; others refuse what they do not know."""
IN_LOOPS = {"xla_cpu_experimental_ynn_fusion_type": ""} if KNOWN else {}
"""Sums over some thousand numbers stay in their loop; handed to a library, as XLA does, they keep it from being one kernel."""
DEVICES = "--xla_force_host_platform_device_count="


def configure(*, fast_loops: bool = True, devices: int | None = None, cache: str | Path | None = None) -> None:
    """Set up JAX for this toolkit; 64-bit floats are switched on.

    Args:
        fast_loops: compile a loop whose buffers are below 100 MB (instead of a few kB) into one kernel, and optimise memory
            accesses across all of it. Loops here have many small operations, and a call for each of them costs more than the
            operation: without, a macro step of a small system takes 2 to 5 times as long. Programs then also run in the
            thread that calls them, which saves some ten microseconds per call.
        devices: number of CPU devices, for `vmri_jax.simulate_batch(..., devices=...)`; one device uses one core.
        cache: folder in which compiled programs are kept between processes.

    Raises:
        RuntimeError: JAX has already started, so that flags would have no effect.
    """
    flags = os.environ.get("XLA_FLAGS", "").split()
    wanted = list(flags)
    if fast_loops and not any(flag.startswith(FAST_LOOPS.split("=")[0]) for flag in flags):  # the user's own stays
        wanted += [FAST_LOOPS, *(f"--{option}={value}" for option, value in IN_LOOPS.items())]
    if devices is not None:
        wanted = [flag for flag in wanted if not flag.startswith(DEVICES)] + [f"{DEVICES}{devices}"]
    if set(wanted) != set(flags):
        if _started():
            raise RuntimeError(
                "runtime.configure: JAX has already started, its flags can no longer change; call configure before the first "
                "computation (before any array is made)."
            )
        os.environ["XLA_FLAGS"] = " ".join(wanted)
    jax.config.update("jax_enable_x64", True)
    if fast_loops:
        jax.config.update("jax_cpu_enable_async_dispatch", False)
    if cache is not None:
        jax.config.update("jax_compilation_cache_dir", str(cache))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def cache_folder() -> Path:
    """Where the command line and the benchmarks keep compiled programs: ``$XDG_CACHE_HOME/vmri_jax``."""
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "vmri_jax"


def _started() -> bool:
    """Whether JAX has a backend."""
    from jax._src import xla_bridge

    return xla_bridge.backends_are_initialized()

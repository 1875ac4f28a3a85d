"""`configure`: the settings of JAX that have to be made before JAX starts.

Importing this module changes no setting. The command line and the benchmarks call `configure`; other programs start
with

    import vmri_jax as vm

    vm.configure()
"""

import hashlib
import os
import platform
from functools import lru_cache
from pathlib import Path

import jax

from vmri_jax.refusals import warn_user

FAST_LOOPS = (
    "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=100000000,-memdep-block-scan-limit=10000",
    "--xla_cpu_prefer_vector_width=512",
    "--xla_disable_hlo_passes=dot-library-rewriter",
)
"""Options of XLA for loops of many small operations, with measured gains in speed:
- loops with buffers below 100 MB, instead of a few kB, become one kernel (3 to 8 times as fast);
- LLVM searches further back for the store whose value can replace a load (short chains 1.4 times);
- instructions fill the vector registers (long chains 1.3 times);
- sums over many lanes stay in the kernel instead of calling a library (batches of high order 2.6 times).
XLA ignores names of passes that it does not know."""
SECONDS_WORTH_KEEPING = 0.0
"""Seconds of compilation from which JAX keeps a program in the cache on disk. With 0.2 s every process compiles
hundreds of small programs anew: 0.7 to 2 s of the time to the first result of a scene."""
ALREADY_STARTED = (
    "configure: JAX has already started, its settings can no longer change; call vm.configure() before any array is "
    "made."
)


class NotConfiguredWarning(UserWarning):
    """Runs are right but slow: the program did not call ``vm.configure()`` before JAX started."""


def configure(*, devices: int | None = None, cache: str | Path | bool | None = True) -> None:
    """Set up JAX for this toolkit: 64-bit floats, and loops that are compiled into one kernel, unless ``XLA_FLAGS`` has
    options of this kind.

    The loops of steppers have many small operations, and a call of a kernel costs more than such an operation: without
    this option a macro step of a small system takes 2 to 5 times as long. Programs also run in the thread that calls
    them, which saves some ten microseconds per call.

    Args:
        devices: number of CPU devices, for `simulate_batch(..., devices=...)`; one device uses one core.
        cache: folder in which JAX keeps compiled programs between processes; True for `cache_folder()`, unless JAX has
            a folder already; False or None leave the setting of JAX. The folder grows with every new program; it may be
            deleted at any time.

    Raises:
        RuntimeError: JAX has already started without these settings.
    """
    if not loops_are_fast():
        if _has_started():
            raise RuntimeError(ALREADY_STARTED)
        flags = os.environ.get("XLA_FLAGS", "")
        added = [flag for flag in FAST_LOOPS if flag.split("=")[0] not in flags]  # options that the user has set stay
        os.environ["XLA_FLAGS"] = " ".join([flags, *added]).strip()
    if devices is not None and devices != _devices():
        if _has_started():
            raise RuntimeError(ALREADY_STARTED)
        jax.config.update("jax_num_cpu_devices", devices)
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    if cache is True:
        known = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
        cache = None if known else cache_folder()
    if cache:
        jax.config.update("jax_compilation_cache_dir", str(cache))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", SECONDS_WORTH_KEEPING)


def loops_are_fast() -> bool:
    """Whether loops become one kernel, or the user has set options of this kind in ``XLA_FLAGS``."""
    return FAST_LOOPS[0].split("=")[0] in os.environ.get("XLA_FLAGS", "")


@lru_cache
def warn_if_slow() -> None:
    """Warn, once per process, that runs on the CPU are slow because `configure` was not called."""
    if jax.default_backend() == "cpu" and not loops_are_fast():
        warn_user(
            "runs take 2 to 5 times as long as they could, because JAX started without the settings of vmri_jax; "
            "results are the same. Add this line at the start of the program, before any array is made: vm.configure() "
            "(with import vmri_jax as vm)",
            NotConfiguredWarning,
        )


def cache_folder() -> Path:
    """Where compiled programs are kept between processes: ``$XDG_CACHE_HOME/vmri_jax``, by default
    ``~/.cache/vmri_jax``."""
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "vmri_jax"


def processor() -> str:
    """A name for processors with this instruction set: a compiled program runs only on the kind of processor that it
    was compiled for."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        features = sorted({line for line in lines if line.startswith(("model name", "flags", "CPU part", "Features"))})
    except OSError:
        features = [platform.processor()]
    return f"{platform.machine()}-{hashlib.sha256(repr(features).encode()).hexdigest()[:8]}"


def _devices() -> int:
    """The configured number of CPU devices, -1 if none is configured."""
    return jax.config.jax_num_cpu_devices  # pyright: ignore[reportAttributeAccessIssue]


def _has_started() -> bool:
    """Whether JAX has started a backend: only then JAX refuses another number of devices."""
    devices = _devices()
    try:
        jax.config.update("jax_num_cpu_devices", max(devices, 0) + 1)
    except RuntimeError:
        return True
    jax.config.update("jax_num_cpu_devices", devices)
    return False

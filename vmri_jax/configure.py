"""What a program says first: `configure`, the settings of JAX that have to be made before it starts.

Nothing here happens at import. The command line and the benchmarks configure themselves; a program of your own starts with

    import vmri_jax as vm

    vm.configure()
"""

import hashlib
import os
import platform
import warnings
from functools import lru_cache
from pathlib import Path

import jax

FAST_LOOPS = (
    "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=100000000,-memdep-block-scan-limit=10000",
    "--xla_cpu_prefer_vector_width=512",
    "--xla_disable_hlo_passes=dot-library-rewriter",
)
"""A loop whose buffers are below 100 MB, instead of a few kB, becomes one kernel (3 to 8 times as fast); a load in it is traced
further back to the store it could be replaced by (short chains 1.4 times); vector registers are filled (long chains 1.3); and
sums over many lanes stay in the kernel, where a library would do them (batches of high order 2.6). XLA ignores names of passes
that it does not know."""
SECONDS_WORTH_KEEPING = 0.2
"""Time to compile from which a program is kept in the cache on disk: reading a file takes some milliseconds. A larger value leaves
more programs to be compiled by every process, a smaller one fills the folder with programs that are compiled as fast as read."""
LATER = "configure: JAX has already started, its settings can no longer change; call vm.configure() before any array is made."


class NotConfiguredWarning(UserWarning):
    """Runs are right but slow: the program did not call ``vm.configure()`` before JAX started."""


def configure(*, fast_loops: bool = True, devices: int | None = None, cache: str | Path | bool | None = True) -> None:
    """Set up JAX for this toolkit: 64-bit floats, and loops that are compiled into one kernel.

    Args:
        fast_loops: compile loops into one kernel. They have many small operations here, and to call a kernel for each costs
            more than the operation: without, a macro step of a small system takes 2 to 5 times as long. Programs then also
            run in the thread that calls them, which saves some ten microseconds per call.
        devices: number of CPU devices, for `simulate_batch(..., devices=...)`; one device uses one core.
        cache: folder in which compiled programs are kept between processes; True for `cache_folder()`, unless JAX has a folder
            already; False or None to leave it as it is. The folder grows with every new program; it may be deleted at any time.

    Raises:
        RuntimeError: JAX has already started without these settings.
    """
    if fast_loops and not loops_are_fast():
        if _has_started():
            raise RuntimeError(LATER)
        flags = os.environ.get("XLA_FLAGS", "")
        wanted = [flag for flag in FAST_LOOPS if flag.split("=")[0] not in flags]  # the user's own stay
        os.environ["XLA_FLAGS"] = " ".join([flags, *wanted]).strip()
    if devices is not None and devices != _devices():
        if _has_started():
            raise RuntimeError(LATER)
        jax.config.update("jax_num_cpu_devices", devices)
    jax.config.update("jax_enable_x64", True)
    if fast_loops:
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
        warnings.warn(
            "runs take 2 to 5 times as long as they could, because JAX started without the settings of vmri_jax; results are "
            "the same. Add this line at the start of the program, before any array is made: vm.configure() "
            "(with import vmri_jax as vm)",
            NotConfiguredWarning,
            stacklevel=4,
        )


def cache_folder() -> Path:
    """Where compiled programs are kept between processes: ``$XDG_CACHE_HOME/vmri_jax``, by default ``~/.cache/vmri_jax``."""
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "vmri_jax"


def processor() -> str:
    """A name of this kind of processor and what it can do: compiled programs serve processors of one kind."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        about = sorted({line for line in lines if line.startswith(("model name", "flags", "CPU part", "Features"))})
    except OSError:
        about = [platform.processor()]
    return f"{platform.machine()}-{hashlib.sha256(repr(about).encode()).hexdigest()[:8]}"


def _devices() -> int:
    """The number of CPU devices that JAX is told to have, -1 if that is not decided."""
    return jax.config.jax_num_cpu_devices  # pyright: ignore[reportAttributeAccessIssue]


def _has_started() -> bool:
    """Whether JAX has a backend: it then refuses another number of devices."""
    devices = _devices()
    try:
        jax.config.update("jax_num_cpu_devices", max(devices, 0) + 1)
    except RuntimeError:
        return True
    jax.config.update("jax_num_cpu_devices", devices)
    return False

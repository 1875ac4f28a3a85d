"""How JAX compiles and runs: settings that have to be made before it starts, and programs that are one kernel.

The library never calls `configure` by itself. The command line and the benchmarks do; in a program of your own call it
first, before anything is computed:

    from vmri_jax import runtime
    runtime.configure()
"""

import math
import os
from collections.abc import Callable
from functools import lru_cache, reduce, wraps
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from vmri_jax.mechanics.structure import called

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
OPTIONS = {**IN_LOOPS, "xla_cpu_prefer_vector_width": 512} if KNOWN else {}
"""For programs that are a whole run: also, vector registers are filled, where the compiler would take half of the widest."""
SHORT = 12
"""Most numbers of a reduction that is written out, see `in_one_kernel`."""
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


def in_one_kernel(function: Callable) -> Callable:
    """`function` of arrays with all of it in one kernel, where loops are (`configure`); not for derivatives.

    Outside of loops XLA launches operations one by one, some of them through its pool of threads: 20 microseconds for the
    start and the end of a run of a small system. Here they are in a loop of one pass; the barrier hides that it is one.

    Whenever a program is called XLA also makes objects for every reduction in it, which takes ten times as long as a short
    reduction itself. Those are written out.
    """

    @wraps(function)
    def once(*args):
        traced, shape = jax.make_jaxpr(function, return_shape=True)(*args)
        rewritten = traced.replace(jaxpr=_rewritten(traced.jaxpr))
        shapes, structure = jax.tree.flatten(shape)
        given = {(a.shape, a.dtype): a for a in map(jnp.asarray, jax.tree.leaves(args))}  # spares kernels for zeros
        nothing = [given.get((a.shape, a.dtype), jnp.zeros(a.shape, a.dtype)) for a in shapes]
        go = jax.lax.optimization_barrier(jnp.asarray(True))

        def only_pass(_):
            return jnp.asarray(False), core.jaxpr_as_fun(rewritten)(*jax.tree.leaves(args))

        return jax.tree.unflatten(structure, jax.lax.while_loop(lambda c: c[0], only_pass, (go, nothing))[1])

    return once


def _rewritten(jaxpr: core.Jaxpr, in_loop: bool = False) -> core.Jaxpr:
    """A jaxpr with what it calls in place, and short reductions written out.

    In loops only those to one number are: XLA would repeat what comes before them for each.
    """
    eqns = []

    def body(loop: core.ClosedJaxpr) -> core.ClosedJaxpr:
        return loop.replace(jaxpr=_rewritten(loop.jaxpr, in_loop=True))

    def copied(jaxpr: core.Jaxpr, inputs) -> list:
        known = dict(zip(jaxpr.invars, inputs, strict=True)) | {v: v for v in jaxpr.constvars}

        def read(v):
            return v if isinstance(v, core.Literal) else known[v]

        for eqn in jaxpr.eqns:
            values, name, params, inner = [read(v) for v in eqn.invars], eqn.primitive.name, eqn.params, called(eqn)
            if inner is not None and not inner[1]:
                outputs = copied(inner[0], values)
            elif name in _WRITTEN_OUT and _is_short(_of(eqn).shape, params["axes"], in_loop):
                outputs = copied(_written_out(name, _of(eqn).shape, _of(eqn).dtype, params["axes"]), values)
            else:
                if name in ("while", "scan"):
                    params = {key: body(value) if key.endswith("jaxpr") else value for key, value in params.items()}
                elif name == "cond":
                    params = {**params, "branches": tuple(map(body, params["branches"]))}
                outputs = [core.Var(v.aval) for v in eqn.outvars]
                eqns.append(eqn.replace(invars=values, outvars=outputs, params=params))
            known |= zip(eqn.outvars, outputs, strict=True)
        return [read(v) for v in jaxpr.outvars]

    return jaxpr.replace(outvars=copied(jaxpr, jaxpr.invars), eqns=eqns)


def _of(eqn: core.JaxprEqn) -> Any:
    """Shape and type of what is reduced."""
    return eqn.invars[0].aval


def _is_short(shape: tuple[int, ...], axes: tuple[int, ...], in_loop: bool) -> bool:
    size, reduced = math.prod(shape), math.prod(shape[axis] for axis in axes)
    return size > 0 and reduced <= SHORT and (reduced == size or not in_loop)


_WRITTEN_OUT = {
    "reduce_sum": jax.lax.add,
    "reduce_max": jax.lax.max,
    "reduce_min": jax.lax.min,
    "reduce_and": jax.lax.bitwise_and,
    "reduce_or": jax.lax.bitwise_or,
}


@lru_cache
def _written_out(name: str, shape: tuple[int, ...], dtype, axes: tuple[int, ...]) -> core.Jaxpr:
    """A reduction over some axes as operations on its parts."""

    def parts(a):
        a = jnp.moveaxis(a, axes, range(len(axes)))
        return reduce(_WRITTEN_OUT[name], (a[index] for index in np.ndindex(a.shape[: len(axes)])))

    return jax.make_jaxpr(parts)(jax.ShapeDtypeStruct(shape, dtype)).jaxpr


def cache_folder() -> Path:
    """Where the command line and the benchmarks keep compiled programs: ``$XDG_CACHE_HOME/vmri_jax``."""
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "vmri_jax"


def _started() -> bool:
    """Whether JAX has a backend."""
    from jax._src import xla_bridge

    return xla_bridge.backends_are_initialized()

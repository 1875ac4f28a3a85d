"""Programs that are one kernel."""

import math
from collections.abc import Callable
from functools import lru_cache, reduce, wraps
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from vmri_jax.mechanics.structure import called

OPTIONS: dict[str, str] = {}
SHORT = 12
"""Most numbers of a reduction that is written out, see `in_one_kernel`."""


def in_one_kernel(function: Callable) -> Callable:
    """`function` of arrays with all of it in one kernel, where loops are (`vmri_jax.configure`); not for derivatives.

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

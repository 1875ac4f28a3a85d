"""Batches with the batch axis last, and so contiguous in memory: `over_lanes` is ``jax.vmap`` for that layout.

``jax.vmap`` puts the batch axis first: a batch of short vectors is stored row by row, (batch, 6), and the compiler gets
loops over six numbers. Stored column by column, (6, batch), it gets loops over the batch, which fill vector registers.
"""

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from vmri_jax.kernels.cpu import ELEMENTWISE
from vmri_jax.mechanics.structure import ELEMENTWISE_PRIMITIVES, called, reached


class _Value(NamedTuple):
    """An array; with `lanes` its last axis is the batch axis."""

    array: Any
    lanes: bool


class _Padded(NamedTuple):
    """A sum of arrays that are padded with zeros along one axis, to the given shape, each from (start) on.

    Derivatives of slices are such sums. Written as one concatenation they cost what is in them, without the zeros.
    """

    shape: tuple[int, ...]
    axis: int
    parts: tuple[tuple[int, Any], ...]

    def __add__(self, other):  # of the same shape and axis
        return self._replace(parts=self.parts + other.parts)

    def assembled(self) -> _Value:
        ends = [(start, start + array.shape[self.axis], array) for start, array in self.parts]
        cuts = sorted({0, self.shape[self.axis], *(x for start, stop, _ in ends for x in (start, stop))})
        pieces = []
        for a, b in pairwise(cuts):
            here = [lax.slice_in_dim(x, a - i, b - i, axis=self.axis) for i, j, x in ends if i <= a and b <= j]
            empty = (*self.shape[: self.axis], b - a, *self.shape[self.axis + 1 :])
            pieces.append(sum(here[1:], here[0]) if here else jnp.zeros(empty, self.parts[0][1].dtype))
        return _Value(lax.concatenate(pieces, self.axis), True)


def _padded(eqn, inputs: list, size: int) -> _Padded | None:
    """The result of an equation as a sum of padded arrays, if it is one."""
    if eqn.primitive.name in ("add", "add_any") and all(isinstance(x, _Padded) for x in inputs):
        a, b = inputs
        return a + b if (a.shape, a.axis) == (b.shape, b.axis) else None
    if eqn.primitive.name != "pad" or not isinstance(inputs[0], _Value) or not inputs[0].lanes:
        return None
    config = eqn.params["padding_config"]
    axes = [i for i, widths in enumerate(config) if any(widths)]
    if len(axes) != 1 or min(config[axes[0]]) < 0 or config[axes[0]][2] or getattr(eqn.invars[1], "val", None) != 0:
        return None
    return _Padded((*eqn.outvars[0].aval.shape, size), axes[0], ((config[axes[0]][0], inputs[0].array),))


def over_lanes(function: Callable, axis_size: int) -> Callable:
    """``function`` over lanes: every array of its argument and of its result has the batch axis last."""

    def batched(tree):
        leaves, structure = jax.tree.flatten(tree)
        one = [jax.ShapeDtypeStruct(a.shape[:-1], a.dtype) for a in leaves]
        jaxpr, shape = jax.make_jaxpr(function, return_shape=True)(jax.tree.unflatten(structure, one))
        results = _run(axis_size, jaxpr.jaxpr, jaxpr.consts, [_Value(a, True) for a in leaves])
        return jax.tree.unflatten(jax.tree.structure(shape), [_spread(axis_size, x) for x in results])

    return batched


def _run(size: int, jaxpr, consts, values: list[_Value]) -> list[_Value]:
    """The outputs of a jaxpr, equation by equation."""
    known: dict[int, Any] = {id(v): _Value(c, False) for v, c in zip(jaxpr.constvars, consts, strict=True)}
    known |= {id(v): x for v, x in zip(jaxpr.invars, values, strict=True)}

    def read(v) -> _Value:
        if hasattr(v, "val"):
            return _Value(v.val, False)
        if isinstance(known[id(v)], _Padded):
            known[id(v)] = known[id(v)].assembled()
        return known[id(v)]

    for eqn in jaxpr.eqns:
        padded = _padded(eqn, [None if hasattr(v, "val") else known[id(v)] for v in eqn.invars], size)
        if padded is not None:
            known[id(eqn.outvars[0])] = padded
            continue
        inputs, name = [read(v) for v in eqn.invars], eqn.primitive.name
        inner = called(eqn)
        if name in _LOOPS:
            outputs = _LOOPS[name](size, inputs, reached(eqn, [x.lanes for x in inputs]), **eqn.params)
        elif inner is not None:
            outputs = _run(size, *inner, inputs)
        elif not any(x.lanes for x in inputs):
            outputs = _results(eqn.primitive, [x.array for x in inputs], eqn.params, False)
        else:
            rank = max((v.aval.ndim for v in eqn.outvars), default=0)
            rule = _elementwise if name in ELEMENTWISE_PRIMITIVES else _RULES.get(name)
            changed = rule and rule(inputs, rank, size, **eqn.params)
            if changed is None:  # no rule, or not for this case
                outputs = _by_vmap(eqn, inputs)
            elif isinstance(changed, _Value):
                outputs = [changed]
            else:
                arrays, params = changed
                outputs = _results(eqn.primitive, arrays, params, True)
        known |= {id(v): x for v, x in zip(eqn.outvars, outputs, strict=True)}
    return [read(v) for v in jaxpr.outvars]


def _results(primitive, arrays, params, lanes: bool) -> list[_Value]:
    results = primitive.bind(*arrays, **params)
    return [_Value(a, lanes) for a in (results if primitive.multiple_results else [results])]


def _by_vmap(eqn, inputs: list[_Value]) -> list[_Value]:
    axes = [-1 if x.lanes else None for x in inputs]

    def call(*arrays):
        return [x.array for x in _results(eqn.primitive, arrays, eqn.params, True)]

    arrays = jax.vmap(call, axes, -1)(*(x.array for x in inputs))
    return [_Value(a, True) for a in arrays]


def _spread(size: int, x: _Value):
    """The array with a batch axis."""
    return x.array if x.lanes else _aligned(x, np.ndim(x.array), size)


def _aligned(x: _Value, rank: int, size: int = 1):
    """The array with a batch axis, and axes of one entry before it up to a rank (scalars have none)."""
    shape = np.shape(x.array)
    if x.lanes:
        shape, size = shape[:-1], shape[-1]
        return x.array if len(shape) == rank else jnp.reshape(x.array, (1,) * rank + (size,))
    return lax.broadcast_in_dim(x.array, (*shape, size), tuple(range(len(shape))))


# Rules: what to bind an equation's primitive to, (arrays, params); or the result itself; or None, then `jax.vmap` does it.


def _elementwise(inputs, rank, size, **params):
    arrays = [_aligned(x, rank, size) if x.lanes or np.ndim(x.array) else x.array for x in inputs]
    shape = np.broadcast_shapes(*(np.shape(a) for a in arrays))
    return [jnp.broadcast_to(a, shape) for a in arrays], params


def _bitcast(inputs, rank, size, *, new_dtype):
    if inputs[0].array.dtype.itemsize != np.dtype(new_dtype).itemsize:
        return None
    return _elementwise(inputs, rank, size, new_dtype=new_dtype)


def _broadcast_in_dim(inputs, rank, size, *, shape, broadcast_dimensions, **params):
    if len(inputs) > 1:
        return None
    return [inputs[0].array], {
        **params,
        "shape": (*shape, size),
        "broadcast_dimensions": (*broadcast_dimensions, len(shape)),
    }


def _reshape(inputs, rank, size, *, new_sizes, dimensions, **params):
    if len(inputs) > 1 or dimensions is not None:
        return None
    return [inputs[0].array], {**params, "new_sizes": (*new_sizes, size), "dimensions": None}


def _same(inputs, rank, size, **params):
    """Axes are named from the first one on."""
    return [x.array for x in inputs], params


def _transpose(inputs, rank, size, *, permutation):
    return [inputs[0].array], {"permutation": (*permutation, len(permutation))}


def _concatenate(inputs, rank, size, *, dimension):
    return [_spread(size, x) for x in inputs], {"dimension": dimension}


def _stack(inputs, rank, size, *, axis):
    return [_spread(size, x) for x in inputs], {"axis": axis}


def _pad(inputs, rank, size, *, padding_config):
    if inputs[1].lanes:
        return None
    return [x.array for x in inputs], {"padding_config": (*padding_config, (0, 0, 0))}


def _slice(inputs, rank, size, *, start_indices, limit_indices, strides):
    limits = {"start_indices": (*start_indices, 0), "limit_indices": (*limit_indices, size)}
    return [inputs[0].array], {**limits, "strides": strides and (*strides, 1)}


def _dynamic_slice(inputs, rank, size, *, slice_sizes):
    operand, *at = inputs
    if any(x.lanes for x in at):
        return None
    return [operand.array, *(x.array for x in at), _zero(at)], {"slice_sizes": (*slice_sizes, size)}


def _dynamic_update_slice(inputs, rank, size):
    operand, update, *at = inputs
    if any(x.lanes for x in at):
        return None
    return [_spread(size, operand), _spread(size, update), *(x.array for x in at), _zero(at)], {}


def _zero(at):
    return np.zeros((), getattr(at[0].array, "dtype", int))


def _dot_general(inputs, rank, size, *, dimension_numbers, **_):
    """A sum of products: axes in the order of the result, then the contracted ones, then the batch axis."""
    contracted, shared = dimension_numbers
    shapes = [np.shape(x.array)[: np.ndim(x.array) - x.lanes] for x in inputs]
    free = [[i for i in range(len(s)) if i not in (*c, *b)] for s, c, b in zip(shapes, contracted, shared, strict=True)]
    if math.prod(shapes[0]) * math.prod(shapes[1][i] for i in free[1]) > ELEMENTWISE**3:
        return None
    first = len(shared[0]) + len(free[0])
    last = first + len(free[1])
    factors = []
    for k, absent in enumerate([range(first, last), range(len(shared[0]), first)]):
        array = _aligned(inputs[k], len(shapes[k]))
        array = jnp.transpose(array, (*shared[k], *free[k], *contracted[k], len(shapes[k])))
        factors.append(jnp.expand_dims(array, tuple(absent)))
    return _Value(jnp.sum(factors[0] * factors[1], axis=tuple(range(last, last + len(contracted[0])))), True)


def _select(inputs, rank, size):
    """A scalar predicate stays one where it is the same for all lanes."""
    which, *cases = inputs
    arrays = [_spread(size, x) for x in cases]
    if which.lanes or np.ndim(which.array):
        return [jnp.broadcast_to(_aligned(which, rank, size), arrays[0].shape), *arrays], {}
    return [which.array, *arrays], {}


_RULES = {
    "broadcast_in_dim": _broadcast_in_dim,
    "bitcast_convert_type": _bitcast,
    "reshape": _reshape,
    "transpose": _transpose,
    "concatenate": _concatenate,
    "stack": _stack,
    "pad": _pad,
    "slice": _slice,
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update_slice,
    "dot_general": _dot_general,
    "select_n": _select,
}
_AXES_NAMED = (
    "squeeze split unstack rev argmax argmin cumsum cummax cumprod reduce_sum reduce_max reduce_min reduce_and"
)
_RULES |= dict.fromkeys([*_AXES_NAMED.split(), "reduce_or"], _same)


# Equations with jaxprs of their own; `lanes`: which of their outputs differ between lanes, known beforehand.


def _while(size, inputs, lanes, *, cond_jaxpr, body_jaxpr, cond_nconsts, body_nconsts):
    cond_consts, body_consts = inputs[:cond_nconsts], inputs[cond_nconsts : cond_nconsts + body_nconsts]
    start = inputs[cond_nconsts + body_nconsts :]

    def test(arrays):
        return _run(size, cond_jaxpr.jaxpr, cond_jaxpr.consts, cond_consts + _values(arrays, lanes))[0]

    def step(arrays):
        new = _run(size, body_jaxpr.jaxpr, body_jaxpr.consts, body_consts + _values(arrays, lanes))
        new, goes_on = _arrays(size, new, lanes), test(arrays)
        if not goes_on.lanes and not np.ndim(goes_on.array):
            return new
        return [a if a is b else _freeze(goes_on, a, b, on) for a, b, on in zip(new, arrays, lanes, strict=True)]

    arrays = lax.while_loop(lambda a: jnp.any(test(a).array), step, _arrays(size, start, lanes))
    return _values(arrays, lanes)


def _freeze(goes_on: _Value, new, old, lanes: bool = True):
    """`new` where it goes on; a predicate of several entries, of a loop under `jax.vmap`, belongs to the first axes."""
    flags = goes_on.array if goes_on.lanes or not lanes else jnp.expand_dims(goes_on.array, -1)
    cut = flags.ndim - lanes
    flags = jnp.reshape(flags, flags.shape[:cut] + (1,) * (new.ndim - flags.ndim) + flags.shape[cut:])
    return lax.select(jnp.broadcast_to(flags, new.shape), new, old)


def _scan(size, inputs, lanes, *, jaxpr, length, reverse, num_consts, num_carry, unroll, **_):
    consts, start, xs = inputs[:num_consts], inputs[num_consts:][:num_carry], inputs[num_consts + num_carry :]

    def step(arrays, x_arrays):
        at = consts + _values(arrays, lanes[:num_carry]) + _values(x_arrays, [x.lanes for x in xs])
        results = _arrays(size, _run(size, jaxpr.jaxpr, jaxpr.consts, at), lanes)
        return results[:num_carry], results[num_carry:]

    start = _arrays(size, start, lanes[:num_carry])
    arrays, ys = lax.scan(step, start, [x.array for x in xs], length, reverse=reverse, unroll=unroll)
    return _values(arrays + ys, lanes)


def _cond(size, inputs, lanes, *, branches, **_):
    index, *operands = inputs
    kept = [x.lanes for x in operands]

    def call(branch, arrays):
        return _run(size, branch.jaxpr, branch.consts, _values(arrays, kept))

    arrays = [x.array for x in operands]
    if index.lanes:  # all branches, one of them chosen
        results = [[_spread(size, x) for x in call(branch, arrays)] for branch in branches]
        which = jnp.clip(index.array, 0, len(branches) - 1)
        out = results[0]
        for k, result in enumerate(results[1:], 1):
            out = [_freeze(_Value(which == k, True), new, old) for new, old in zip(result, out, strict=True)]
        return _values(out, [True] * len(out))

    calls = [lambda arrays, b=branch: _arrays(size, call(b, arrays), lanes) for branch in branches]
    return _values(lax.switch(index.array, calls, arrays), lanes)


def _values(arrays, lanes) -> list[_Value]:
    return [_Value(a, on) for a, on in zip(arrays, lanes, strict=True)]


def _arrays(size, values: list[_Value], lanes: list[bool]) -> list:
    return [_spread(size, x) if on else jnp.asarray(x.array) for x, on in zip(values, lanes, strict=True)]


_LOOPS = {"while": _while, "scan": _scan, "cond": _cond}

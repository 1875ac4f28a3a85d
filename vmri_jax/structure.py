"""What a function's jaxpr tells about it: which arguments it depends on, and the structure of its Hessian.

All answers are structural and conservative: what is called dependent may happen not to be (``0 * x`` counts), what is
called independent, constant or diagonal is so.
"""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

# fmt: off
ELEMENTWISE_PRIMITIVES = frozenset([
    "abs", "acos", "acosh", "add", "add_any", "and", "asin", "asinh", "atan", "atan2", "atanh", "cbrt", "ceil",
    "clamp", "convert_element_type", "copy", "cos", "cosh", "div", "eq", "erf", "erf_inv", "erfc", "exp", "exp2",
    "expm1", "floor", "ge", "gt", "integer_pow", "is_finite", "le", "lgamma", "log", "log1p", "logistic", "lt",
    "max", "min", "mul", "ne", "neg", "not", "or", "pow", "rem", "round", "rsqrt", "select_n", "sign", "sin",
    "sinh", "sqrt", "square", "stop_gradient", "sub", "tan", "tanh",
])
# fmt: on
CALLS = ("jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "remat", "checkpoint")


def called(eqn) -> tuple[Any, Any] | None:
    """(jaxpr, consts) of what an equation of a jaxpr calls, None if it is no call."""
    inner = eqn.params.get("jaxpr") or eqn.params.get("call_jaxpr")
    if eqn.primitive.name not in CALLS or inner is None:
        return None
    return getattr(inner, "jaxpr", inner), getattr(inner, "consts", ())


def depends_on(function: Callable, *args) -> tuple[bool, ...]:
    """Whether the outputs of ``function(*args)`` can depend on each argument."""
    jaxpr = jax.make_jaxpr(function)(*args).jaxpr
    needed = {id(v) for v in jaxpr.outvars}
    for eqn in reversed(jaxpr.eqns):
        if any(id(v) in needed for v in eqn.outvars):
            needed.update(id(v) for v in eqn.invars)
    leaves = [jax.tree.structure(a).num_leaves for a in args]
    stops = np.cumsum(leaves)
    used = [id(v) in needed for v in jaxpr.invars]
    return tuple(any(used[stop - n : stop]) for n, stop in zip(leaves, stops, strict=True))


def has_constant_hessian(function: Callable, *args) -> bool:
    """Whether ``function(*args) -> ()`` is at most quadratic in its arguments."""

    def product(args, directions):
        return jax.jvp(jax.grad(lambda a: function(*a)), (args,), (directions,))[1]

    return not depends_on(product, args, args)[0]


def has_diagonal_hessian(function: Callable, q) -> bool:
    """Whether ``function(q) -> ()`` is a sum over the elements of the vector q: each gradient entry sees its own alone."""
    closed = jax.make_jaxpr(jax.grad(function))(q)
    return _classes(closed.jaxpr, [_ELEMENT])[0] <= _ELEMENT


def has_curvature(function: Callable, q) -> np.ndarray:
    """For every element of the vector q whether the gradient of ``function(q) -> ()`` by it can depend on q at all."""
    closed = jax.make_jaxpr(jax.grad(function))(q)
    return _seen(closed.jaxpr, [np.ones(q.shape, dtype=bool)])[0]


def _seen(jaxpr, seen: list[np.ndarray]) -> list[np.ndarray]:
    """For every element of each output whether it can depend on those elements of the inputs."""
    known = dict(zip(map(id, jaxpr.invars), seen, strict=True))

    def of(v) -> np.ndarray:
        return known.get(id(v), np.zeros(v.aval.shape, dtype=bool))

    for eqn in jaxpr.eqns:
        inputs, shapes = [of(v) for v in eqn.invars], [v.aval.shape for v in eqn.outvars]
        inner = called(eqn)
        moved = _MOVES.get(eqn.primitive.name)
        if not any(a.any() for a in inputs):
            outputs = [np.zeros(shape, dtype=bool) for shape in shapes]
        elif inner is not None:
            outputs = _seen(inner[0], inputs)
        elif eqn.primitive.name in ELEMENTWISE_PRIMITIVES:
            outputs = [np.broadcast_to(np.any(np.broadcast_arrays(*inputs), axis=0), shapes[0])]
        elif moved is not None:
            outputs = moved(shapes[0], *inputs, **eqn.params)
            outputs = outputs if isinstance(outputs, list) else [outputs]
        else:
            outputs = [np.ones(shape, dtype=bool) for shape in shapes]
        known.update(zip(map(id, eqn.outvars), outputs, strict=True))
    return [of(v) for v in jaxpr.outvars]


def _sliced(_, a, /, *, start_indices, limit_indices, strides):
    strides = strides or (1,) * a.ndim
    return a[tuple(slice(*at) for at in zip(start_indices, limit_indices, strides, strict=True))]


def _padded(shape, a, value, /, *, padding_config):
    if any(low < 0 or high < 0 for low, high, _ in padding_config):
        return np.ones(shape, dtype=bool)
    padded, config = np.full(shape, bool(value)), zip(shape, padding_config, strict=True)
    padded[tuple(slice(low, size - high, inner + 1) for size, (low, high, inner) in config)] = a
    return padded


def _broadcast(shape, a, /, *, broadcast_dimensions, **_):
    sizes = dict(zip(broadcast_dimensions, a.shape, strict=True))
    return np.broadcast_to(a.reshape([sizes.get(i, 1) for i in range(len(shape))]), shape)


_MOVES = {
    "slice": _sliced,
    "pad": _padded,
    "broadcast_in_dim": _broadcast,
    "reshape": lambda shape, a, /, **_: a.reshape(shape),
    "squeeze": lambda shape, a, /, **_: a.reshape(shape),
    "rev": lambda _, a, /, *, dimensions: np.flip(a, dimensions),
    "split": lambda _, a, /, *, sizes, axis: np.split(a, np.cumsum(sizes)[:-1], axis),
    "transpose": lambda _, a, /, *, permutation: a.transpose(permutation),
    "concatenate": lambda _, /, *parts, dimension: np.concatenate(parts, axis=dimension),
    "reduce_sum": lambda _, a, /, *, axes, **kinds: a.any(axis=axes),
}

_CONSTANT, _ELEMENT, _MIXED = range(3)


def _classes(jaxpr, classes: list[int]) -> list[int]:
    """How each output sees the input vector: not at all, element by element, or otherwise."""
    known = dict(zip(map(id, jaxpr.invars), classes, strict=True))
    for eqn in jaxpr.eqns:
        inputs = [known.get(id(v), _CONSTANT) for v in eqn.invars]
        inner = called(eqn)
        if max(inputs, default=_CONSTANT) == _CONSTANT:
            outputs = [_CONSTANT] * len(eqn.outvars)
        elif inner is not None:
            outputs = _classes(inner[0], inputs)
        elif eqn.primitive.name in ELEMENTWISE_PRIMITIVES and _MIXED not in inputs:
            outputs = [_ELEMENT] * len(eqn.outvars)
        else:
            outputs = [_MIXED] * len(eqn.outvars)
        known.update(zip(map(id, eqn.outvars), outputs, strict=True))
    return [known.get(id(v), _CONSTANT) for v in jaxpr.outvars]

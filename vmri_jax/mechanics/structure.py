"""Properties of functions from their jaxprs: dependence of outputs on inputs, the structure of Hessians, and the sizes
of terms that cancel.

The answers on structure are conservative. "Independent", "constant" and "diagonal" are certain; "dependent" may be
wrong (``0 * x`` depends on x). Outputs of an operation that is unknown here depend on all its inputs, and nothing is
known about functions with effects.

Derivatives at random points would also show zeros of a Hessian, but no zeros of functions with `where`, and to compile
them takes 0.3 s of processor time for each question, thirty times as long as to trace the function.

The sizes of the terms that cancel in a function are ``|d| + L`` for the constraint ``|d| - L``. The jaxpr is evaluated
once more with a size for every number: the sizes of a sum are added, a rearrangement, and a product with a number that
does not depend on the arguments, take the size along, and every other operation starts from the modulus of its value.
"""

from collections.abc import Callable
from functools import reduce
from itertools import pairwise
from operator import add

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters.partial_eval import dce_jaxpr

ENTRY_BY_ENTRY = frozenset(["add", "add_any", "convert_element_type", "copy", "div", "mul", "neg", "select_n", "sub"])
"""Linear operations whose entry i depends on the entries i of their inputs alone."""
# fmt: off
SUMS = frozenset(["add", "add_any", "sub"])
TAKES_SIZES_ALONG = frozenset([
    "broadcast_in_dim", "concatenate", "convert_element_type", "copy", "cumsum", "dynamic_slice",
    "dynamic_update_slice", "gather", "neg", "pad", "reduce_sum", "reshape", "rev", "scatter", "scatter-add",
    "select_n", "slice", "split", "squeeze", "stack", "transpose", "unstack",
])
PRODUCTS = frozenset(["mul", "div", "dot_general"])
# fmt: on
CALLS = ("jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "remat", "checkpoint")


def interpreted(jaxpr, inputs: list, rule: Callable, constant: Callable) -> list:
    """The outputs of a jaxpr under another meaning of its numbers.

    Args:
        jaxpr: its calls of functions are entered.
        inputs: meanings of its constants and of its arguments.
        rule: ``rule(eqn, meanings of the inputs)`` are the meanings of the outputs of an operation.
        constant: the meaning of a number that the jaxpr itself has.
    """
    known = dict(zip([*jaxpr.constvars, *jaxpr.invars], inputs, strict=True))

    def meaning(v):
        return constant(v.val) if hasattr(v, "val") else known[v]

    for eqn in jaxpr.eqns:
        parts, inner = list(map(meaning, eqn.invars)), eqn.params.get("jaxpr") or eqn.params.get("call_jaxpr")
        if eqn.primitive.name not in CALLS or inner is None:
            outputs = rule(eqn, parts)
        else:
            constants = map(constant, getattr(inner, "consts", ()))
            outputs = interpreted(getattr(inner, "jaxpr", inner), [*constants, *parts], rule, constant)
        known.update(zip(eqn.outvars, outputs, strict=True))
    return list(map(meaning, jaxpr.outvars))


def depends_on(function: Callable, *args) -> tuple[bool, ...]:
    """Whether the outputs of ``function(*args)`` can depend on each argument."""
    jaxpr = jax.make_jaxpr(function)(*args).jaxpr
    if jaxpr.effects:
        return (True,) * len(args)
    is_used = dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))[1]
    ends = np.cumsum([0, *(jax.tree.structure(a).num_leaves for a in args)])
    return tuple(any(is_used[first:end]) for first, end in pairwise(ends))


def entries_seen(function: Callable, q) -> np.ndarray:
    """(n,) whether the outputs of ``function(q)`` can depend on each entry of the vector q."""
    used = _combinations(_kept(function, q), [np.eye(q.size)])
    return np.any([np.zeros(q.size, bool), *(a.any(axis=tuple(range(a.ndim - 1))) for a in used)], axis=0)


def has_constant_hessian(function: Callable, *args) -> bool:
    """Whether ``function(*args) -> ()`` is at most quadratic in its arguments."""
    return not depends_on(_times_hessian(lambda args: function(*args)), args, args)[0]


def is_linear(function: Callable, q) -> bool:
    """Whether ``function(q) -> ()`` is at most linear in q."""
    return not depends_on(jax.grad(function), q)[0]


def has_diagonal_hessian(function: Callable, q) -> bool:
    """Whether ``function(q) -> ()`` is a sum over the entries of the vector q: entry i of the gradient depends on q_i
    alone.

    The product of the Hessian with a vector is linear in the vector, and of the linear operations few act entry by
    entry.
    """
    jaxpr, mixes = _kept(_times_hessian(function), q, q), []

    def depends(eqn, marked):
        mixes.append(any(marked) and eqn.primitive.name not in ENTRY_BY_ENTRY)
        return [any(marked)] * len(eqn.outvars)

    if jaxpr is None:
        return False
    interpreted(jaxpr, [False] * len(jaxpr.constvars) + [False, True], depends, lambda _: False)
    return not any(mixes)


def _kept(function: Callable, *args):
    """The jaxpr of ``function(*args)`` with the operations alone on which its outputs depend; None for a function with
    effects."""
    jaxpr = jax.make_jaxpr(function)(*args).jaxpr
    return None if jaxpr.effects else dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars), instantiate=True)[0]


def _times_hessian(function: Callable) -> Callable:
    """The product ``(q, direction) -> H(q) direction`` with the Hessian of ``function(q) -> ()``."""
    return lambda q, direction: jax.jvp(jax.grad(function), (q,), (direction,))[1]


def curved_directions(function: Callable, q) -> np.ndarray:
    """L (d, n) of rank d, with the Hessian of ``function(q) -> ()`` of the form ``L^T w(q) L`` everywhere.

    For a potential of the distance of two points, L takes the difference of their positions. The rows of L are read
    from the jaxpr of the product of the Hessian with a vector: linear combinations of its entries with known
    coefficients are followed up to the first operation that is not linear in this sense.
    """
    n = q.size
    used = _combinations(_kept(_times_hessian(function), q, q), [np.zeros((n, n)), np.eye(n)])
    return _independent(np.unique(np.concatenate([np.zeros((1, n)), *(a.reshape(-1, n) for a in used)]), axis=0))


def _independent(rows: np.ndarray) -> np.ndarray:
    """A sparse basis of the row space, chosen among the rows (k, n); unit vectors if its rank is the number of columns
    with non-zeros."""
    kept = np.zeros((0, rows.shape[1]))
    for row in sorted(rows, key=np.count_nonzero):
        if np.linalg.matrix_rank(more := np.concatenate([kept, row[None]])) == len(more):
            kept = more
    entries = rows.any(axis=0)
    return np.eye(rows.shape[1])[entries] if len(kept) == entries.sum() else kept


def _combinations(jaxpr, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Coefficients (..., n) of the linear combinations of n numbers that a jaxpr returns, or takes into an operation
    that is not in `_LINEAR`.

    `inputs` are the coefficients of its arguments. A jaxpr that is not known, None, may take every number alone.
    """
    n, used = inputs[0].shape[-1], []
    if jaxpr is None:
        return [np.eye(n)]

    def zeros(shape):
        return np.zeros((*shape, n))

    def combined(eqn, parts):
        linear = _LINEAR.get(eqn.primitive.name)
        if all(a is not None and not a.any() for a in parts):
            return [zeros(v.aval.shape) for v in eqn.outvars]
        if linear is None or any(a is None for a in parts):
            used.extend(parts)
            return [None] * len(eqn.outvars)
        outputs = linear(eqn, *parts)
        return outputs if isinstance(outputs, list) else [outputs]

    inputs = [*(zeros(v.aval.shape) for v in jaxpr.constvars), *inputs]
    used += interpreted(jaxpr, inputs, combined, lambda value: zeros(np.shape(value)))
    return [a for a in used if a is not None]


def _shape(eqn) -> tuple[int, ...]:
    return eqn.outvars[0].aval.shape


def _sliced(eqn, a):
    ends = eqn.params["start_indices"], eqn.params["limit_indices"], eqn.params["strides"] or (1,) * len(_shape(eqn))
    return a[tuple(slice(*bounds) for bounds in zip(*ends, strict=True))]


def _padded(eqn, a, _):
    for axis, (size, (low, _, inner)) in enumerate(zip(_shape(eqn), eqn.params["padding_config"], strict=True)):
        a = np.moveaxis(a, axis, 0)
        places = low + (inner + 1) * np.arange(len(a))
        inside = (places >= 0) & (places < size)
        padded = np.zeros((size, *a.shape[1:]))
        padded[places[inside]] = a[inside]
        a = np.moveaxis(padded, 0, axis)
    return a


def _broadcast(eqn, a):
    sizes = dict(zip(eqn.params["broadcast_dimensions"], a.shape, strict=False))
    ones = [sizes.get(i, 1) for i in range(len(_shape(eqn)))]
    return np.broadcast_to(a.reshape(*ones, a.shape[-1]), (*_shape(eqn), a.shape[-1]))


_LINEAR = {
    "neg": lambda _, a: -a,
    "add": lambda _, a, b: a + b,
    "add_any": lambda _, a, b: a + b,
    "sub": lambda _, a, b: a - b,
    "reduce_sum": lambda eqn, a: a.sum(axis=eqn.params["axes"]),
    "slice": _sliced,
    "pad": _padded,
    "broadcast_in_dim": _broadcast,
    "reshape": lambda eqn, a: a.reshape(*_shape(eqn), a.shape[-1]),
    "squeeze": lambda eqn, a: a.reshape(*_shape(eqn), a.shape[-1]),
    "rev": lambda eqn, a: np.flip(a, eqn.params["dimensions"]),
    "split": lambda eqn, a: np.split(a, np.cumsum(eqn.params["sizes"])[:-1], eqn.params["axis"]),
    "transpose": lambda eqn, a: a.transpose(*eqn.params["permutation"], a.ndim - 1),
    "concatenate": lambda eqn, *parts: np.concatenate(parts, axis=eqn.params["dimension"]),
}


def sizes_of_terms(function: Callable, *args):
    """The sizes of the terms in every value of ``function(*args)``, in the units of the values."""
    closed = jax.make_jaxpr(function)(*args)
    # numbers are pairs (value, size); the size is None for a number that does not depend on the arguments
    numbers = [*((a, None) for a in closed.consts), *((a, jnp.abs(a)) for a in jax.tree.leaves(args))]
    outputs = interpreted(closed.jaxpr, numbers, _sized, lambda value: (value, None))
    return jax.tree.unflatten(jax.tree.structure(jax.eval_shape(function, *args)), map(_size, outputs))


def _sized(eqn, numbers) -> list:
    """The outputs of an operation as pairs (value, size)."""
    name, depends = eqn.primitive.name, [size is not None for _, size in numbers]
    values = _applied(eqn, [value for value, _ in numbers])
    is_multiple = name in PRODUCTS and sum(depends) == 1 and not (name == "div" and depends[1])
    if not any(depends):
        sizes = [None] * len(values)
    elif name in SUMS or name == "neg":
        sizes = [reduce(add, map(_size, numbers))]
    elif is_multiple or name in TAKES_SIZES_ALONG:
        sizes = _applied(eqn, list(map(_size, numbers)))
    else:
        sizes = map(jnp.abs, values)
    return list(zip(values, sizes, strict=True))


def _applied(eqn, values) -> list:
    outputs = eqn.primitive.bind(*values, **eqn.params)
    return outputs if eqn.primitive.multiple_results else [outputs]


def _size(number):
    value, size = number
    if size is not None:
        return size
    return jnp.abs(value) if jnp.issubdtype(jnp.result_type(value), jnp.floating) else value

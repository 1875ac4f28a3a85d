"""Structure of functions from their jaxprs: dependence of outputs on inputs, and the structure of Hessians.

The answers are structural and conservative. "Independent", "constant" and "diagonal" are certain; "dependent" may be wrong (``0 * x``
depends on x). Outputs of an operation that is unknown here depend on all its inputs, and nothing is known about functions with effects.

Derivatives at random points would also show zeros of a Hessian, but no zeros of functions with `where`, and to compile them takes 0.3 s of
processor time for each question, thirty times as long as to trace the function.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import jax
import numpy as np
from jax.interpreters.partial_eval import dce_jaxpr

ENTRY_BY_ENTRY = frozenset(["add", "add_any", "convert_element_type", "copy", "div", "mul", "neg", "select_n", "sub"])
"""Linear operations whose entry i depends on the entries i of their inputs alone."""
CALLS = ("jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "remat", "checkpoint")


def called(eqn) -> tuple[Any, Any] | None:
    """(jaxpr, consts) of the function that an equation of a jaxpr calls, None if the equation is no call."""
    inner = eqn.params.get("jaxpr") or eqn.params.get("call_jaxpr")
    if eqn.primitive.name not in CALLS or inner is None:
        return None
    return getattr(inner, "jaxpr", inner), getattr(inner, "consts", ())


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
    jaxpr, n, used = _kept(function, q), q.size, []
    if jaxpr is None:
        return np.ones(n, bool)
    used += _combinations(n, jaxpr, [np.eye(n)], used)
    marks = [a.any(axis=tuple(range(a.ndim - 1))) for a in used if a is not None]
    return np.any([np.zeros(n, bool), *marks], axis=0)


def has_constant_hessian(function: Callable, *args) -> bool:
    """Whether ``function(*args) -> ()`` is at most quadratic in its arguments."""
    return not depends_on(_times_hessian(lambda args: function(*args)), args, args)[0]


def is_linear(function: Callable, q) -> bool:
    """Whether ``function(q) -> ()`` is at most linear in q."""
    return not depends_on(jax.grad(function), q)[0]


def has_diagonal_hessian(function: Callable, q) -> bool:
    """Whether ``function(q) -> ()`` is a sum over the entries of the vector q: entry i of the gradient depends on q_i alone.

    The product of the Hessian with a vector is linear in the vector, and of the linear operations few act entry by entry.
    """
    jaxpr = _kept(_times_hessian(function), q, q)
    return jaxpr is not None and not _mixes(jaxpr, [False, True])


def _mixes(jaxpr, marked: list[bool]) -> bool:
    """Whether an operation of a jaxpr takes different entries of the marked inputs together."""
    depends = {id(v) for v, is_marked in zip(jaxpr.invars, marked, strict=True) if is_marked}
    for eqn in jaxpr.eqns:
        marked, inner = [id(v) in depends for v in eqn.invars], called(eqn)
        if any(marked):
            if eqn.primitive.name not in ENTRY_BY_ENTRY if inner is None else _mixes(inner[0], marked):
                return True
            depends.update(map(id, eqn.outvars))
    return False


def _kept(function: Callable, *args):
    """The jaxpr of ``function(*args)`` with the operations alone on which its outputs depend; None for a function with effects."""
    jaxpr = jax.make_jaxpr(function)(*args).jaxpr
    return None if jaxpr.effects else dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars), instantiate=True)[0]


def _times_hessian(function: Callable) -> Callable:
    """The product ``(q, direction) -> H(q) direction`` with the Hessian of ``function(q) -> ()``."""
    return lambda q, direction: jax.jvp(jax.grad(function), (q,), (direction,))[1]


def curved_directions(function: Callable, q) -> np.ndarray:
    """L (d, n) of rank d, with the Hessian of ``function(q) -> ()`` of the form ``L^T w(q) L`` everywhere.

    For a potential of the distance of two points, L takes the difference of their positions. The rows of L are read from the jaxpr of the
    product of the Hessian with a vector: linear combinations of its entries with known coefficients are followed up to the first operation
    that is not linear in this sense.
    """
    jaxpr, n, used = _kept(_times_hessian(function), q, q), q.size, []
    if jaxpr is None:
        return np.eye(n)
    used += _combinations(n, jaxpr, [np.zeros((n, n)), np.eye(n)], used)
    rows = [np.zeros((1, n)), *(a.reshape(-1, n) for a in used if a is not None)]
    return _independent(np.unique(np.concatenate(rows), axis=0))


def _independent(rows: np.ndarray) -> np.ndarray:
    """A sparse basis of the row space, chosen among the rows (k, n); unit vectors if its rank is the number of columns with non-zeros."""
    kept = np.zeros((0, rows.shape[1]))
    for row in sorted(rows, key=np.count_nonzero):
        if np.linalg.matrix_rank(more := np.concatenate([kept, row[None]])) == len(more):
            kept = more
    entries = rows.any(axis=0)
    return np.eye(rows.shape[1])[entries] if len(kept) == entries.sum() else kept


def _combinations(n: int, jaxpr, inputs: list, used: list) -> list:
    """The outputs of a jaxpr as linear combinations of n numbers: coefficients (..., n), None for an output that is no known combination.

    `inputs` are coefficients or None; `used` gets the combinations that enter any operation that is not in `_LINEAR`.
    """
    known = dict(zip(map(id, jaxpr.invars), inputs, strict=True))
    for eqn in jaxpr.eqns:
        parts = [known.get(id(v), np.zeros((*v.aval.shape, n))) for v in eqn.invars]
        inner, linear = called(eqn), _LINEAR.get(eqn.primitive.name)
        if not any(a is None or a.any() for a in parts):
            continue
        if inner is not None:
            outputs = _combinations(n, inner[0], parts, used)
        elif linear is not None and all(a is not None for a in parts):
            outputs = linear(eqn, *parts)
        else:
            used += parts
            outputs = [None] * len(eqn.outvars)
        known.update(zip(map(id, eqn.outvars), outputs if isinstance(outputs, list) else [outputs], strict=True))
    return [known.get(id(v), np.zeros((*v.aval.shape, n))) for v in jaxpr.outvars]


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

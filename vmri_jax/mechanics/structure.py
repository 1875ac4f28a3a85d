"""Structure of functions from their jaxprs: dependence of outputs on inputs, and the structure of Hessians.

The answers are structural and conservative. "Independent", "constant" and "diagonal" are certain; "dependent" may be wrong (``0 * x``
depends on x). Outputs of an operation that is unknown here depend on all its inputs, and nothing is known about functions with effects.
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
    """(jaxpr, consts) of the function that an equation of a jaxpr calls, None if the equation is no call."""
    inner = eqn.params.get("jaxpr") or eqn.params.get("call_jaxpr")
    if eqn.primitive.name not in CALLS or inner is None:
        return None
    return getattr(inner, "jaxpr", inner), getattr(inner, "consts", ())


def reached(jaxpr, inputs: list[bool]) -> list[bool]:
    """Whether each output of a jaxpr can depend on an input that is marked in `inputs`."""
    return [dependence > _CONSTANT for dependence in _classes(jaxpr, [_MIXED if on else _CONSTANT for on in inputs])]


def _by_while(eqn, inputs: list[bool]) -> list[bool]:
    """While loop: if the condition depends on a marked input, all outputs do."""
    try:
        of_cond, of_body = eqn.params["cond_nconsts"], eqn.params["body_nconsts"]
        cond, body = eqn.params["cond_jaxpr"].jaxpr, eqn.params["body_jaxpr"].jaxpr
    except KeyError:
        return [any(inputs)] * len(eqn.outvars)
    cond_consts, body_consts = inputs[:of_cond], inputs[of_cond : of_cond + of_body]

    def once(carry):
        end = reached(cond, cond_consts + carry)[0]
        return [end or on for on in reached(body, body_consts + carry)]

    return _over_and_over(once, inputs[of_cond + of_body :])


def _by_scan(eqn, inputs: list[bool]) -> list[bool]:
    """Scan: shapes tell the carry, since scanned inputs and stacked outputs have one more axis outside of the loop than inside."""
    inner = eqn.params["jaxpr"].jaxpr
    num_carry = sum(a.aval.shape == b.aval.shape for a, b in zip(eqn.outvars, inner.outvars, strict=True))
    num_xs = sum(a.aval.shape != b.aval.shape for a, b in zip(eqn.invars, inner.invars, strict=True))
    first = len(inputs) - num_xs - num_carry
    consts, carry, xs = inputs[:first], inputs[first : first + num_carry], inputs[first + num_carry :]
    carry = _over_and_over(lambda carry: reached(inner, consts + carry + xs)[:num_carry], carry)
    return carry + reached(inner, consts + carry + xs)[num_carry:]


def _over_and_over(once: Callable, carry: list[bool]) -> list[bool]:
    """The marks of the carry of a loop after any number of turns: the fixed point of `once`."""
    marks = [a or b for a, b in zip(carry, once(carry), strict=True)]
    return carry if marks == carry else _over_and_over(once, marks)


def _by_cond(eqn, inputs: list[bool]) -> list[bool]:
    """Branches: if the index depends on a marked input, all outputs do."""
    index, *operands = inputs
    cases = [reached(branch.jaxpr, operands) for branch in eqn.params["branches"]]
    return [index or any(case) for case in zip(*cases, strict=True)]


_LOOPS = {"while": _by_while, "scan": _by_scan, "cond": _by_cond}


def depends_on(function: Callable, *args) -> tuple[bool, ...]:
    """Whether the outputs of ``function(*args)`` can depend on each argument."""
    jaxpr = jax.make_jaxpr(function)(*args).jaxpr
    if jaxpr.effects:
        return (True,) * len(args)
    of_argument = np.repeat(np.arange(len(args)), [jax.tree.structure(a).num_leaves for a in args])
    return tuple(any(reached(jaxpr, (of_argument == i).tolist())) for i in range(len(args)))


def entries_seen(function: Callable, q) -> np.ndarray:
    """(n,) whether the outputs of ``function(q)`` can depend on each entry of the vector q."""
    jaxpr, n = jax.make_jaxpr(function)(q).jaxpr, q.size
    seen = np.zeros(n, bool)
    if not n or jaxpr.effects:
        return ~seen
    used: list[np.ndarray] = []
    used += _combinations(n, jaxpr, [np.eye(n)], jaxpr.outvars, used)
    for combinations in used:
        if combinations is not None:
            seen |= combinations.reshape(-1, n).any(axis=0)
    return seen


def has_constant_hessian(function: Callable, *args) -> bool:
    """Whether ``function(*args) -> ()`` is at most quadratic in its arguments."""

    def product(args, directions):
        return jax.jvp(jax.grad(lambda a: function(*a)), (args,), (directions,))[1]

    return not depends_on(product, args, args)[0]


def is_linear(function: Callable, q) -> bool:
    """Whether ``function(q) -> ()`` is at most linear in q."""
    return not depends_on(jax.grad(function), q)[0]


def has_diagonal_hessian(function: Callable, q) -> bool:
    """Whether ``function(q) -> ()`` is a sum over the entries of the vector q: entry i of the gradient depends on q_i alone."""
    jaxpr = jax.make_jaxpr(jax.grad(function))(q).jaxpr
    return not jaxpr.effects and _classes(jaxpr, [_ELEMENT])[0] <= _ELEMENT


def curved_directions(function: Callable, q) -> np.ndarray:
    """L (d, n) of rank d, with the Hessian of ``function(q) -> ()`` of the form ``L^T w(q) L`` everywhere.

    For a potential of the distance of two points, L takes the difference of their positions. The rows of L are read from the jaxpr of the
    product of the Hessian with a vector: linear combinations of its entries with known coefficients are followed up to the first operation
    that is not linear in this sense.
    """

    def product(q, direction):
        return jax.jvp(jax.grad(function), (q,), (direction,))[1]

    used: list[np.ndarray] = []
    jaxpr, n = jax.make_jaxpr(product)(q, q).jaxpr, q.size
    if jaxpr.effects:
        return np.eye(n)
    used += _combinations(n, jaxpr, [np.zeros((n, n)), np.eye(n)], jaxpr.outvars, used)
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


def _combinations(n: int, jaxpr, inputs: list, wanted: list, used: list) -> list:
    """The outputs of a jaxpr as linear combinations of n numbers: coefficients (..., n), None for an output that is no known combination.

    `inputs` are coefficients or None, `wanted` the variables of the outputs that matter; `used` gets the combinations that enter any operation
    that is not in `_LINEAR`.
    """
    known = dict(zip(map(id, jaxpr.invars), inputs, strict=True))
    eqns, needed = _needed(jaxpr, wanted)
    for eqn in eqns:
        parts = [known.get(id(v), np.zeros((*v.aval.shape, n))) for v in eqn.invars]
        inner, linear = called(eqn), _LINEAR.get(eqn.primitive.name)
        if not any(a is None or a.any() for a in parts):
            continue
        if inner is not None:
            inner_wanted = [v for v, outer in zip(inner[0].outvars, eqn.outvars, strict=True) if id(outer) in needed]
            outputs = _combinations(n, inner[0], parts, inner_wanted, used)
        elif linear is not None and all(a is not None for a in parts):
            outputs = linear(eqn, *parts)
        else:
            used += parts
            outputs = [None] * len(eqn.outvars)
        known.update(zip(map(id, eqn.outvars), outputs if isinstance(outputs, list) else [outputs], strict=True))
    return [known.get(id(v), np.zeros((*v.aval.shape, n))) for v in jaxpr.outvars]


def _needed(jaxpr, wanted) -> tuple[list, set[int]]:
    """The equations of a jaxpr on which the variables `wanted` depend, and the ids of the variables on which they depend."""
    needed, eqns = {id(v) for v in wanted}, []
    for eqn in reversed(jaxpr.eqns):
        if any(id(v) in needed for v in eqn.outvars):
            needed.update(id(v) for v in eqn.invars)
            eqns.append(eqn)
    return eqns[::-1], needed


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

_CONSTANT, _ELEMENT, _MIXED = range(3)


def _classes(jaxpr, classes: list[int]) -> list[int]:
    """The dependence of each output on the input vector: none, entry by entry, or mixed."""
    known = dict(zip(map(id, jaxpr.invars), classes, strict=True))
    for eqn in jaxpr.eqns:
        inputs = [known.get(id(v), _CONSTANT) for v in eqn.invars]
        inner, loop = called(eqn), _LOOPS.get(eqn.primitive.name)
        largest = max(inputs, default=_CONSTANT)
        if inner is not None:
            outputs = _classes(inner[0], inputs)
        elif loop is not None:
            outputs = [
                _MIXED if on else _CONSTANT for on in loop(eqn, [dependence > _CONSTANT for dependence in inputs])
            ]
        elif largest == _CONSTANT or eqn.primitive.name in ELEMENTWISE_PRIMITIVES:
            outputs = [largest] * len(eqn.outvars)
        else:
            outputs = [_MIXED] * len(eqn.outvars)
        known.update(zip(map(id, eqn.outvars), outputs, strict=True))
    return [known.get(id(v), _CONSTANT) for v in jaxpr.outvars]

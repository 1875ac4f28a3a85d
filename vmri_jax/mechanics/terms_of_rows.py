"""Sizes of the terms that cancel in a function: ``|d| + L`` for the constraint ``|d| - L``.

The jaxpr of the function is evaluated once more with a size for every number: the sizes of a sum are added, a rearrangement, and a
product with a number that does not depend on the arguments, take the size along, and every other operation starts from the modulus of its value.
"""

import jax
import jax.numpy as jnp

from vmri_jax.mechanics.structure import called

# fmt: off
SUMS = frozenset(["add", "add_any", "sub"])
TAKES_SIZES_ALONG = frozenset([
    "broadcast_in_dim", "concatenate", "convert_element_type", "copy", "cumsum", "dynamic_slice", "dynamic_update_slice", "gather", "neg",
    "pad", "reduce_sum", "reshape", "rev", "scatter", "scatter-add", "select_n", "slice", "split", "squeeze", "stack", "transpose", "unstack",
])
PRODUCTS = frozenset(["mul", "div", "dot_general"])
# fmt: on


def sizes_of_terms(function, *args):
    """The sizes of the terms in every value of ``function(*args)``, in the units of the values."""
    closed = jax.make_jaxpr(function)(*args)
    numbers = [(a, None) for a in closed.consts], [(a, jnp.abs(a)) for a in jax.tree.leaves(args)]
    values = _evaluated(closed.jaxpr, *numbers)
    return jax.tree.unflatten(jax.tree.structure(jax.eval_shape(function, *args)), [_size(number) for number in values])


def _evaluated(jaxpr, consts, arguments) -> list:
    """The outputs of a jaxpr as pairs (value, size), from such pairs; the size is None for a number that does not depend on the arguments."""
    known = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *arguments], strict=True))

    def number(variable):
        return (variable.val, None) if hasattr(variable, "val") else known[variable]

    for eqn in jaxpr.eqns:
        inputs, inner = [number(v) for v in eqn.invars], called(eqn)
        if inner is not None:
            outputs = _evaluated(inner[0], [(a, None) for a in inner[1]], inputs)
        else:
            values = _applied(eqn, [value for value, _ in inputs])
            outputs = list(zip(values, _sizes(eqn, inputs, values), strict=True))
        known.update(zip(eqn.outvars, outputs, strict=True))
    return [number(v) for v in jaxpr.outvars]


def _applied(eqn, values) -> list:
    outputs = eqn.primitive.bind(*values, **eqn.params)
    return outputs if eqn.primitive.multiple_results else [outputs]


def _sizes(eqn, inputs, values) -> list:
    """The sizes of the outputs of an operation, from its inputs and the values of its outputs."""
    name, depends = eqn.primitive.name, [size is not None for _, size in inputs]
    if not any(depends):
        return [None] * len(values)
    if name in SUMS:
        return [_size(inputs[0]) + _size(inputs[1])]
    is_multiple = name in PRODUCTS and sum(depends) == 1 and not (name == "div" and depends[1])
    if name == "neg" or not (is_multiple or name in TAKES_SIZES_ALONG):
        return [_size(inputs[0])] if name == "neg" else [jnp.abs(value) for value in values]
    return _applied(eqn, [_size(number) for number in inputs])


def _size(number):
    value, size = number
    if size is not None:
        return size
    return jnp.abs(value) if jnp.issubdtype(jnp.result_type(value), jnp.floating) else value

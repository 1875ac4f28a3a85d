"""The order in which dictionaries of parameters were written.

JAX sorts the names of a dictionary whenever it takes a pytree apart: in jit, grad and vmap, and in ``jax.tree.map``. Functions of the user may rely on
the order of writing, ``zip(params["k"].values(), q_f.values())``. So the order is kept with the functions, and every dictionary is put
back into its order before a function is called, while JAX traces.
"""

from typing import Any, NamedTuple

import jax


class Order(NamedTuple):
    """Names in a dictionary in the order of writing, and orders of its entries.

    Args:
        names: keys of the dictionary; None for a list, a tuple or another node of a pytree.
        parts: order of each entry, None for an entry without dictionaries.
    """

    names: tuple[Any, ...] | None
    parts: tuple["Order | None", ...]


def order_of(tree: Any) -> Order | None:
    """The order of all dictionaries in a pytree; None if there is only one order."""
    if isinstance(tree, dict):
        parts = tuple(map(order_of, tree.values()))
        return Order(tuple(tree), parts) if len(tree) > 1 or any(parts) else None
    parts = tuple(None if child is tree else order_of(child) for child in _children(tree)[0])
    return Order(None, parts) if any(parts) else None


def in_order(tree: Any, order: Order | None) -> Any:
    """The pytree with its dictionaries in an order; names that the order does not know come last."""
    if order is None:
        return tree
    if order.names is not None and isinstance(tree, dict):
        parts, ordered = dict(zip(order.names, order.parts, strict=True)), tree.copy()
        for name in [*(name for name in parts if name in tree), *(name for name in tree if name not in parts)]:
            ordered[name] = in_order(ordered.pop(name), parts.get(name))  # moved to the end
        return ordered
    children, structure = _children(tree)
    if order.names is not None or len(children) != len(order.parts):
        return tree
    return jax.tree.unflatten(structure, map(in_order, children, order.parts))


def _children(tree: Any) -> tuple[list, Any]:
    """The entries of the outermost node of a pytree, and the structure of this node."""
    return jax.tree.flatten(tree, is_leaf=lambda node: node is not tree)

"""Summaries that `print` and notebooks show: a title, and named lines in words and a few numbers, never whole
arrays."""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete

MOST_LISTED = 6
"""Most names or numbers in a line or in a message. A larger number makes them longer and harder to read."""
MOST_PARAMETERS = 12
"""Most entries of `params` in a line. A larger number makes lines longer."""


def summary(title: str, lines: Mapping[str, str]) -> str:
    """A title and a line for each name, indented; names without text are left out."""
    shown = {name: text for name, text in lines.items() if text}
    width = max(map(len, shown), default=0)
    return "\n".join([title, *(f"  {name:<{width}}  {text}" for name, text in shown.items())])


def has_values(tree) -> bool:
    """Whether a pytree has leaves, and all are readable numbers or arrays: no tracers, placeholders or donated
    arrays."""
    leaves = jax.tree.leaves(tree)
    kinds = (np.ndarray, np.generic, jax.Array, int, float)
    return (
        bool(leaves)
        and is_concrete(tree)
        and all(isinstance(leaf, kinds) for leaf in leaves)
        and not any(isinstance(leaf, jax.Array) and leaf.is_deleted() for leaf in leaves)
    )


def listed(items: Sequence[str], most: int = MOST_LISTED) -> str:
    """The first `most` items with commas between them, and the number of the others."""
    return ", ".join(items[:most]) + (f" and {len(items) - most} more" if len(items) > most else "")


def numbers(values) -> str:
    """The numbers of a vector in a line, with names if it is a mapping; of a matrix, a tracer or another object its
    shape."""
    if isinstance(values, Mapping):
        return listed([f"{name} {numbers(value)}" for name, value in values.items()]) or "none"
    if not has_values(values) or np.ndim(values) > 1:
        return eqx.tree_pformat(values, width=1000)
    return listed([f"{x:.6g}" for x in np.atleast_1d(np.asarray(values))]) or "none"


def coordinates(names: Sequence[str]) -> str:
    """Number and names of coordinates, in words."""
    if not names:
        return "none"
    return f"{len(names)} coordinate{'s' if len(names) > 1 else ''}: {listed(names)}"


def parameters(params: Any) -> str:
    """Parameters by name, numbers by value and arrays by shape."""
    if not isinstance(params, Mapping):
        return "" if params is None else _short(params)
    return listed([f"{name} = {_short(value)}" for name, value in params.items()], MOST_PARAMETERS)


def _short(value) -> str:
    leaves = jax.tree.leaves(value)
    if len(leaves) > 1:
        return f"{len(leaves)} arrays"
    [value] = leaves or [value]
    return f"{float(value):.6g}" if has_values(value) and np.ndim(value) == 0 else eqx.tree_pformat(value, width=1000)

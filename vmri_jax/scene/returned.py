"""Checks of the function of an effect before the scene is sorted, so that messages name the effect: its value, and constraints at the start."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from vmri_jax.mechanics.arrays import is_concrete
from vmri_jax.mechanics.checks import describe, shape_of
from vmri_jax.mechanics.constraints import START, Rows
from vmri_jax.refusals import Refused
from vmri_jax.scene.declare import arrays

LIBRARY = "vmri_jax."
"""Beginning of the names of modules whose functions are not checked: the tests of the package do that."""


def check_function(effect: Any, moved: bool) -> None:
    """Refuse a function of the user with a wrong value, and a constraint that the start violates unless `moved`.

    The function gets each group of equal elements, as the terms of the system do.
    """
    if effect.kind == "control" or getattr(effect.function, "__module__", "").startswith(LIBRARY):
        return
    for group in effect.by_size():
        q = jax.device_put(effect.positions(group))
        t, v = jax.device_put(((np.zeros(()),), tuple(np.zeros(x.shape) for x in q)))
        before = {"force": (*t, q, v), "kinetic": (q, v)}.get(effect.kind, (*t, q) if effect.timed else (q,))
        arguments = *before, arrays(effect.params_of(group))
        value = shape_of(f"{effect.name}: function", effect.function, *arguments)
        _check_value(effect, value, [x.shape for x in q], len(group))
        if effect.kind == "constraint" and not moved and is_concrete(arguments):
            rows = _rows(effect.function, *arguments)
            if np.any(np.abs(rows.values) > rows.allowed(START)):
                raise Refused(
                    f"{effect.name}: the positions at the start violate this constraint by {np.abs(rows.values).max():.3g}; move the "
                    "bodies, or let the scene do so, Scene(..., project=True)."
                )


def _rows(constraint, *arguments) -> Rows:
    """The `Rows` of a constraint of positions, its last argument but one."""
    *before, q, params = arguments
    flat, by_role = ravel_pytree(q)
    return Rows.of(lambda flat: jnp.ravel(constraint(*before, by_role(flat), params)), flat)


def _check_value(effect: Any, value: Any, sizes: list[tuple[int, ...]], count: int) -> None:
    """Refuse a value of a function of `count` elements, as shapes, whose roles have the shapes `sizes`."""
    shape = getattr(value, "shape", None)
    if effect.kind == "force":
        fits = isinstance(value, tuple | list) and [getattr(x, "shape", None) for x in value] == sizes
        expected = (
            f"a tuple with a force for each body, of shapes {', '.join(map(str, sizes))}: (force,) of a single body"
        )
    elif effect.kind == "constraint":
        fits = shape is not None and (len(shape) < 2 or count > 1)
        expected = "a vector (k,) of values that are kept zero, or one value ()"
    else:
        fits, expected = shape == (), "an energy, a scalar of shape (), the sum over all elements"
    if not fits:
        raise Refused(f"{effect.name}: function returns {describe(value)}; it must return {expected}.")

"""Configurations as dictionaries of arrays: functions of the user get ``q_f["load"]``, all other code has one flat vector.

A `Layout` gives the place of every array in the flat vector. `vmri_jax.Problem` knows the layouts, and `flat_system` wraps every function
of its system once: the function gets dictionaries, and forces and constraint rows that it returns as dictionaries become vectors. No
code behind the problem handles dictionaries.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import library, real_array
from vmri_jax.mechanics.functions import TracedOnce, traced_once
from vmri_jax.mechanics.masses import ConstantMass
from vmri_jax.mechanics.order import InOrder, Order, in_order
from vmri_jax.mechanics.system import System
from vmri_jax.mechanics.terms import Term
from vmri_jax.refusals import Refused

SLOW, FAST = ("q_s", "v_s"), ("q_f", "v_f")
"""Names of the arguments that are slow, and fast, positions or velocities."""


@dataclass(frozen=True)
class Layout:
    """Names and shapes of arrays, in their order in a flat vector; compared by value."""

    shapes: tuple[tuple[str, tuple[int, ...]], ...]

    @classmethod
    def of(cls, name: str, arrays: Mapping[str, Any]) -> "Layout":
        """The layout of a dictionary, in its own order.

        Args:
            name: name of the dictionary in messages.
            arrays: real numbers by name.

        Raises:
            TypeError: a name that is no text, a value that is no array of real numbers.
        """
        for body in arrays:
            if not isinstance(body, str) or not body:
                raise Refused(f"{name} has the key {body!r}; give arrays by names of bodies, {{'load': [0.0, -5.0]}}.")
        return cls(tuple((body, real_array(f"{name}[{body!r}]", array).shape) for body, array in arrays.items()))

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> "Layout":
        """The inverse of `dataclasses.asdict`, also after a round trip through JSON."""
        return cls(tuple((name, tuple(shape)) for name, shape in data["shapes"]))

    @property
    def sizes(self) -> dict[str, int]:
        """Number of coordinates of each array."""
        return {name: math.prod(shape) for name, shape in self.shapes}

    def flat(self, name: str, arrays: Mapping[str, Any], *, zeros: bool = False, per_row: bool = False):
        """The vector (n,) of a dictionary of arrays.

        Args:
            name: name of the dictionary in messages.
            arrays: by name, each of the shape of its position; one number only for one number.
            zeros: whether bodies without an entry have zeros; else every body needs an entry.
            per_row: whether a value may have the leading axes of its position alone, as masses do, see `ConstantMass`.

        Raises:
            ValueError: names or shapes of another configuration.
        """
        bodies = dict(self.shapes)
        unknown = [body for body in arrays if body not in bodies]
        absent = [body for body in bodies if body not in arrays]
        if unknown or (absent and not zeros):
            raise Refused(
                f"{name} has the keys {', '.join(map(str, arrays)) or 'none'}; give {', '.join(bodies) or 'none'}."
            )
        pieces = []
        for body, shape in self.shapes:
            value = real_array(f"{name}[{body!r}]", arrays.get(body, np.zeros(shape)))
            seen = value.shape
            if value.size == math.prod(shape) == 1:
                value = value.reshape(shape)
            elif per_row:  # the axes that the value lacks are the last ones, where NumPy would put them first
                value = value.reshape(*seen, *(1,) * (len(shape) - value.ndim))
            if value.shape != shape and not (per_row and _repeats(value.shape, shape)):
                rows = (
                    f"one number, an array {shape[:1]} with a number for each row, or"
                    if per_row and shape
                    else "an array of"
                )
                raise Refused(
                    f"{name}[{body!r}] has shape {seen}, and the position has {shape}; give {rows} shape {shape}."
                )
            pieces.append(library(value).broadcast_to(value, shape).reshape(-1))
        return library(pieces).concatenate([*pieces, library(pieces).zeros(0)])

    def by_name(self, vectors) -> dict[str, Any]:
        """Arrays (..., *shape) by name of vectors (..., n)."""
        arrays, start = {}, 0
        for name, shape in self.shapes:
            stop = start + math.prod(shape)
            arrays[name] = vectors[..., start:stop].reshape(*vectors.shape[:-1], *shape)
            start = stop
        return arrays


@dataclass(frozen=True)
class ByName:
    """A function of dictionaries as a function of flat vectors; two of these are equal if their functions and layouts are.

    Args:
        function: of the user.
        arguments: names of its arguments, in order.
        slow, fast: layouts of q_s, v_s and of q_f, v_f; None where these are vectors.
    """

    function: Callable
    arguments: tuple[str, ...]
    slow: Layout | None
    fast: Layout | None

    def __call__(self, *arguments):
        value = self.by_name(*arguments)
        if isinstance(value, Mapping):  # rows of constraints
            return jnp.concatenate([jnp.reshape(rows, (-1,)) for rows in value.values()] or [jnp.zeros(0)])
        if isinstance(value, tuple):  # forces
            parts = zip(("F_s", "F_f"), value, (self.slow, self.fast), strict=False)
            return tuple(
                layout.flat(f"System: force: {name}", part, zeros=True)
                if layout and isinstance(part, Mapping)
                else part
                for name, part, layout in parts
            )
        return value

    def by_name(self, *arguments):
        """The value of the user's function, with dictionaries as the user returns them."""
        try:
            return self.function(*map(self._argument, self.arguments, arguments))
        except KeyError as error:
            sides = {"q_s": self.slow, "q_f": self.fast}
            names = [f"{side} has {', '.join(layout.sizes) or 'none'}" for side, layout in sides.items() if layout]
            raise KeyError(f"{error.args[0]!r} is not there; {' and '.join(names)}") from error

    def row_sizes(self, order: Order | None, *arguments) -> dict[str, int]:
        """Number of rows of each constraint that the function returns by name, in its order; empty if it returns a vector.

        Args:
            order: of the params.
        """
        sizes: dict[str, int] = {}

        def note_sizes(*arguments):
            value = self.by_name(*arguments[:-1], in_order(arguments[-1], order))
            if isinstance(value, Mapping):
                sizes.update({name: jnp.size(rows) for name, rows in value.items()})
            return ()

        jax.eval_shape(note_sizes, *arguments)
        return sizes

    def _argument(self, name: str, value):
        layout = self.slow if name in SLOW else self.fast if name in FAST else None
        return value if layout is None else layout.by_name(value)


def flat_system(system: System, slow: Layout | None, fast: Layout | None) -> System:
    """The same system as functions of flat vectors.

    Args:
        system: with functions of dictionaries, wrapped or not.
        slow, fast: layouts of q_s and q_f; None for vectors.

    Raises:
        ValueError: masses of bodies that are not in the layouts.
    """

    def flat(term: Term):
        masses = term.function
        if isinstance(masses, ConstantMass):
            return ConstantMass(_flat_mass("slow", masses.slow, slow), _flat_mass("fast", masses.fast, fast))
        return _wrapped(term.function, (*term.arguments, "params"), slow, fast)

    return system.mapped(flat)


def _repeats(shape: tuple[int, ...], whole: tuple[int, ...]) -> bool:
    """Whether an array of the first shape may be repeated along its axes of length 1 to fill the second shape."""
    return len(shape) == len(whole) and all(n in (1, full) for n, full in zip(shape, whole, strict=True))


def constraint_sizes(function: Callable | None, *arguments) -> dict[str, int]:
    """Names and numbers of rows of a constraint that returns its rows by name; empty for other constraints."""
    inner, order = _inner(function)
    return inner.row_sizes(order, *arguments) if isinstance(inner, ByName) else {}


def _inner(function) -> tuple[Any, Order | None]:
    """The function in a `TracedOnce`, and the order of its params."""
    inner = function.function if isinstance(function, TracedOnce) else function
    return (inner.function, inner.order) if isinstance(inner, InOrder) else (inner, None)


def _wrapped(function, arguments: tuple[str, ...], slow: Layout | None, fast: Layout | None) -> TracedOnce:
    inner, order = _inner(function)
    return traced_once(inner if isinstance(inner, ByName) else ByName(inner, arguments, slow, fast), order)


def _flat_mass(name: str, mass, layout: Layout | None):
    if not isinstance(mass, Mapping):
        return mass
    if layout is None:
        raise Refused(
            f"ConstantMass: {name} has masses by name, {', '.join(mass)}, but the {name} coordinates are a vector; give both as dictionaries, "
            "or both as arrays."
        )
    return layout.flat(f"ConstantMass: {name}", mass, per_row=True)

"""Declarations of the fields of an effect: the bodies that it depends on, and the parameters of its function.

    class Spring(Effect):
        between: Any = names(2)
        stiffness: Any = positive()
        length: Any = positive(default=None, measured=True)

`Effect` reads these declarations to make elements and arrays of parameters, to check them, and to word messages.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import MISSING, dataclass, field
from itertools import combinations
from typing import Any, Literal, dataclass_transform

import jax
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete, library, real_array
from vmri_jax.mechanics.functions import in_order, order_of
from vmri_jax.refusals import Refused
from vmri_jax.scene.body import Bodies, Frame, Point, entry, is_entry

Elements = tuple[tuple[str, ...], ...]
Sign = Literal["", "positive", "at least zero"]


@dataclass(frozen=True)
class Names:
    """A field with names of bodies.

    Args:
        count: number of bodies in each element.
        pairs: whether a list of bodies stands for all pairs of these bodies.
        may_be_all: whether None stands for all bodies of the scene except frames.
    """

    count: int
    pairs: bool = False
    may_be_all: bool = False

    def elements(self, argument: Any, bodies: Bodies, about: str) -> Elements:
        """The elements of an argument ``("a", "b")``, ``[("a", "b"), ("b", "c")]`` or None; `about` begins messages."""
        if argument is None and self.may_be_all:
            argument = tuple(name for name, body in bodies.items() if not isinstance(body, Frame))
        items = _listed(argument)
        flat = bool(items) and all(map(is_entry, items))
        if self.pairs and flat:
            if len(items) < 2:
                raise Refused(f"{about} is {argument!r}; give at least two bodies, or a list of pairs.")
            return tuple(combinations(map(entry, items), 2))
        elements = (items,) if self.count > 1 and flat else tuple(map(_listed, items))
        wrong = any(len(element) != self.count or not all(map(is_entry, element)) for element in elements)
        if not elements or wrong:
            expected = "the name of a body" if self.count == 1 else f"{self.count} names of bodies"
            raise Refused(
                f"{about} is {argument!r}; give {expected}, or a list of such. A point in a rigid body is (name, [x, "
                "y, z])."
            )
        return tuple(tuple(map(entry, element)) for element in elements)


def _listed(argument: Any) -> tuple[Any, ...]:
    """The items of a list; a name alone, or what is no list, as the only item."""
    return tuple(argument) if isinstance(argument, Iterable) and not is_entry(argument) else (argument,)


def items_of(about: str, argument: Any, kind: type, expected: str) -> tuple[Any, ...]:
    """The items of a list whose items have one class, called `expected` in messages; `about` begins messages."""
    if isinstance(argument, kind) or not isinstance(argument, Iterable):
        raise Refused(f"{about} is {argument!r}; give a list.")
    items = tuple(argument)
    for item in items:
        if not isinstance(item, kind):
            raise Refused(f"{about} has {item!r}; each must be {expected}.")
    return items


@dataclass(frozen=True)
class Parameter:
    """A field with numbers that the function of an effect gets as an array.

    Args:
        shape: "number", () the same for all n elements or (n,); "vector", (d,) or (n, d), which the function gets as
            (n, d), for n = 1 as (d,); "common", (d,) the same for all elements; "array", any shape, the same for all
            elements.
        sign: "positive", "at least zero", or "" for any.
        measured: if True, the value at the start takes the place of None, see `Effect.rest`; if False, params lack a
            field that is None.
        may_be_number: whether a number () is allowed instead of a common vector.
    """

    shape: Literal["number", "vector", "common", "array"]
    sign: Sign = ""
    measured: bool = False
    may_be_number: bool = False

    def array(self, about: str, argument: Any, bodies: Sequence[Point]) -> Any:
        """The array that the function gets; `bodies` are the first of every element, `about` begins messages."""
        value = real_array(about, argument)
        value = np.asarray(value) if is_concrete(value) else value
        count, size = len(bodies), bodies[0].size
        if self.shape == "number" and value.shape not in ((), (count,)):
            raise Refused(f"{about} has shape {value.shape}; give one number, or one for each of the {count} elements.")
        if self.shape == "number" and count == 1:
            return value.reshape(())  # a single element has no axis, also if its number is given in a list
        if self.shape in ("number", "array") or (self.may_be_number and value.ndim == 0):
            return value
        value = library(value).atleast_1d(value)
        if self.shape == "common":
            for body in bodies:
                if value.shape != (body.size,):
                    raise Refused(
                        f"{about} has shape {value.shape}, {body.name} has dimension {body.size}; they must agree."
                    )
            return value
        if value.shape not in ((size,), (count, size)):
            for_each = f", or one for each, ({count}, {size})." if count > 1 else "."
            raise Refused(
                f"{about} has shape {value.shape}; its bodies have dimension {size}, give ({size},){for_each}"
            )
        return value.reshape(size) if count == 1 else library(value).broadcast_to(value, (count, size))


def names(count: int = 1, *, default: Any = MISSING, pairs: bool = False) -> Any:
    """Names of bodies, `count` in each element; if None is the default it stands for all bodies of the scene."""
    return field(default=default, metadata={"names": Names(count, pairs, may_be_all=default is None)})


def number(*, default: Any = MISSING, sign: Sign = "", measured: bool = False) -> Any:
    """A number for all elements, or a number for each."""
    return field(default=default, metadata={"parameter": Parameter("number", sign, measured)})


def positive(*, default: Any = MISSING, measured: bool = False) -> Any:
    """A positive number for all elements, or a positive number for each."""
    return field(default=default, metadata={"parameter": Parameter("number", "positive", measured)})


def vector(*, default: Any = MISSING) -> Any:
    """A vector for all elements, or a vector for each."""
    return field(default=default, metadata={"parameter": Parameter("vector")})


def common(*, default: Any = MISSING, may_be_number: bool = False) -> Any:
    """A vector that is the same for all elements."""
    return field(default=default, metadata={"parameter": Parameter("common", may_be_number=may_be_number)})


def array(*, default: Any = MISSING, sign: Sign = "") -> Any:
    """An array of any shape that is the same for all elements."""
    return field(default=default, metadata={"parameter": Parameter("array", sign)})


def of_time() -> Any:
    """A function of the user, ``f(t, params)``: the first argument of the function of the effect, which gets `params`
    by the name of this field."""
    return field(metadata={"of_time": True})


@dataclass_transform(
    frozen_default=True,
    eq_default=False,
    field_specifiers=(names, number, positive, vector, common, array, of_time, field),
)
class Declared:
    """Base class of frozen dataclasses: subclasses declare their fields by the functions above, and need no
    decorator."""

    def __init_subclass__(cls):
        dataclass(frozen=True, eq=False)(cls)


def stacked(values: Sequence[Any]):
    """The values (n, ...) of n elements in one array; for n = 1 without this axis.

    Of NumPy unless a value is traced.
    """
    return library(values).asarray(values[0]) if len(values) == 1 else library(values).stack(values)


def lasting(value):
    """The value, with iterators replaced by tuples, which can be read more than once."""
    if isinstance(value, Iterator) or (isinstance(value, list | tuple) and any(isinstance(v, Iterator) for v in value)):
        return tuple(lasting(item) for item in value)
    return value


def arrays(tree: Any) -> Any:
    """The numbers of a pytree as arrays of JAX, in the order of writing."""
    return in_order(jax.device_put(tree), order_of(tree))


def real_tree(about: str, tree):
    """A pytree of real numbers as a pytree of arrays, in the order of writing; the error for another leaf begins with
    `about` and its place."""

    def convert(path, leaf):
        array = real_array(about + jax.tree_util.keystr(path), leaf)
        return np.asarray(array) if is_concrete(array) else array

    return in_order(jax.tree_util.tree_map_with_path(convert, tree), order_of(tree))

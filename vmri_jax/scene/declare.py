"""How an effect declares its fields: the bodies that it touches, and the parameters of its function.

    @effect_class
    class Spring(Effect):
        between: Any = names(2)
        stiffness: Any = positive()
        length: Any = positive(default=None, measured=True)

`Effect` reads these declarations: elements, arrays of parameters, checks and messages follow from them.
"""

from collections.abc import Iterable, Sequence
from dataclasses import MISSING, dataclass, field
from itertools import combinations
from typing import Any, Literal, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete, real_array
from vmri_jax.scene.body import Bodies, Frame, Point, entry, is_entry

Elements = tuple[tuple[str, ...], ...]
Sign = Literal["", "positive", "at least zero"]
Class = TypeVar("Class")


@dataclass(frozen=True)
class Names:
    """A field with names of bodies, so many in each element.

    Args:
        pairs: a list of bodies stands for all pairs of them.
        may_be_all: None stands for all bodies of the scene, without frames.
    """

    count: int
    pairs: bool = False
    may_be_all: bool = False

    def elements(self, given: Any, bodies: Bodies, what: str) -> Elements:
        """Elements of one of them, ``("a", "b")``, or several, ``[("a", "b"), ("b", "c")]``; of all bodies if None is the default.

        Args:
            what: the names of effect and field, for messages.

        Raises:
            ValueError: elements of another number of bodies, or none at all.
        """
        if given is None and self.may_be_all:
            given = tuple(name for name, body in bodies.items() if not isinstance(body, Frame))
        items: tuple[Any, ...] = (given,) if is_entry(given) else tuple(given) if isinstance(given, Iterable) else ()
        flat = bool(items) and all(is_entry(item) for item in items)
        if self.pairs and flat:
            if len(items) < 2:
                raise ValueError(f"{what} is {given!r}; give at least two bodies, or a list of pairs.")
            return tuple(combinations(map(entry, items), 2))
        if self.count > 1 and flat:
            items = (items,)
        elements = tuple((item,) if is_entry(item) else tuple(item) for item in items)
        wrong = any(len(element) != self.count or not all(map(is_entry, element)) for element in elements)
        if not elements or wrong:
            one = "the name of a body" if self.count == 1 else f"{self.count} names of bodies"
            raise ValueError(
                f"{what} is {given!r}; give {one}, or a list of such. A point in a rigid body is (name, [x, y, z])."
            )
        return tuple(tuple(map(entry, element)) for element in elements)


@dataclass(frozen=True)
class Parameter:
    """A field with numbers that the function of an effect gets as an array.

    Args:
        shape: "number", one for all elements, (), or one for each, (n,); "vector", likewise (d,) or (n, d), and repeated;
            "common", a vector (d,) for all elements alike; "array", of any shape, for all elements alike.
        sign: "positive", "at least zero", or "" for any.
        measured: None stands for the value at the start, see `Effect.rest`. Otherwise a field that is None is left out.
        may_be_number: a number () is allowed instead of a common vector.
    """

    shape: Literal["number", "vector", "common", "array"]
    sign: Sign = ""
    measured: bool = False
    may_be_number: bool = False

    def array(self, what: str, given: Any, bodies: Sequence[Point]) -> jax.Array:
        """The numbers as the function gets them.

        Args:
            what: the names of effect and field, for messages.
            given: the numbers as the user gave them.
            bodies: what the effect sees of the first body of every element.

        Raises:
            TypeError: what is no real number.
            ValueError: arrays of float32, not one number or one for each element, vectors of another dimension than the bodies.
        """
        value = jnp.asarray(real_array(what, given))
        count, size = len(bodies), bodies[0].size
        if self.shape == "number" and value.shape not in ((), (count,)):
            raise ValueError(
                f"{what} has shape {value.shape}; give one number, or one for each of the {count} elements."
            )
        if self.shape in ("number", "array") or (self.may_be_number and value.ndim == 0):
            return value
        value = jnp.atleast_1d(value)
        if self.shape == "common":
            for body in bodies:
                if value.shape != (body.size,):
                    raise ValueError(
                        f"{what} has shape {value.shape}, {body.name} has dimension {body.size}; they must agree."
                    )
            return value
        if value.shape not in ((size,), (count, size)):
            more = f", or one for each, ({count}, {size})." if count > 1 else "."
            raise ValueError(f"{what} has shape {value.shape}; its bodies have dimension {size}, give ({size},){more}")
        return squeeze(jnp.broadcast_to(value, (count, size)))

    def check_sign(self, what: str, given: Any) -> None:
        """Refuse numbers of another sign.

        Args:
            what: the names of effect and field, for messages.
            given: the numbers as the user gave them.
        """
        if self.sign and is_concrete(given):
            value = np.asarray(given, dtype=float)
            if not np.all(value > 0 if self.sign == "positive" else value >= 0):
                raise ValueError(f"{what} is {value}; it must be {self.sign}.")


def names(count: int = 1, *, default: Any = MISSING, pairs: bool = False) -> Any:
    """Names of bodies, `count` in each element; if None is the default it stands for all bodies of the scene."""
    return field(default=default, metadata={"names": Names(count, pairs, may_be_all=default is None)})


def number(*, default: Any = MISSING, sign: Sign = "", measured: bool = False) -> Any:
    """One number for all elements, or one for each."""
    return field(default=default, metadata={"parameter": Parameter("number", sign, measured)})


def positive(*, default: Any = MISSING, measured: bool = False) -> Any:
    """One positive number for all elements, or one for each."""
    return field(default=default, metadata={"parameter": Parameter("number", "positive", measured)})


def vector(*, default: Any = MISSING) -> Any:
    """One vector for all elements, or one for each."""
    return field(default=default, metadata={"parameter": Parameter("vector")})


def common(*, default: Any = MISSING, may_be_number: bool = False) -> Any:
    """One vector, the same for all elements."""
    return field(default=default, metadata={"parameter": Parameter("common", may_be_number=may_be_number)})


def array(*, default: Any = MISSING, sign: Sign = "") -> Any:
    """Numbers of any shape, the same for all elements."""
    return field(default=default, metadata={"parameter": Parameter("array", sign)})


def of_time() -> Any:
    """A function of the user, ``f(t, params)``."""
    return field(metadata={"of_time": True})


@dataclass_transform(
    frozen_default=True,
    eq_default=False,
    field_specifiers=(names, number, positive, vector, common, array, of_time, field),
)
def effect_class(cls: type[Class]) -> type[Class]:
    """A frozen dataclass whose fields may be declared by `names`, `positive` and the like."""
    return dataclass(frozen=True, eq=False)(cls)


def squeeze(values):
    """(n,) values of n elements; of a single one, ()."""
    return values[0] if len(values) == 1 else values

"""The one map from names to the entries of a flat vector."""

import math
import operator
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete, library, real_array
from vmri_jax.refusals import Refused


@dataclass(frozen=True)
class Slots:
    """Names and shapes of arrays, in their order in a flat vector; compared by value."""

    shapes: tuple[tuple[str, tuple[int, ...]], ...]

    @classmethod
    def of(cls, name: str, arrays: Mapping[str, Any]) -> "Slots":
        """The slots of a dictionary, in its own order.

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
    def of_sizes(cls, sizes: Mapping[str, int | tuple[int, ...]]) -> "Slots":
        """The slots of arrays with these shapes, or of vectors with these numbers of entries."""
        return cls(tuple((name, (size,) if isinstance(size, int) else size) for name, size in sizes.items()))

    @property
    def sizes(self) -> dict[str, int]:
        """Number of entries of each array."""
        return {name: math.prod(shape) for name, shape in self.shapes}

    @property
    def size(self) -> int:
        """Number of all entries."""
        return sum(self.sizes.values())

    @property
    def slices(self) -> dict[str, slice]:
        """The entries of each array in the flat vector."""
        ends = np.cumsum([0, *self.sizes.values()]).tolist()
        return {name: slice(*ends[i : i + 2]) for i, (name, _) in enumerate(self.shapes)}

    def by_name(self, vectors) -> dict[str, Any]:
        """Arrays (..., *shape) by name of vectors (..., n)."""
        pieces = zip(self.shapes, self.slices.values(), strict=True)
        return {name: vectors[..., entries].reshape(*vectors.shape[:-1], *shape) for (name, shape), entries in pieces}

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
        if not arrays.keys() <= bodies.keys() or (not zeros and arrays.keys() != bodies.keys()):
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
            lengths = [{1, full} if per_row else {full} for full in shape]  # of rows an axis of length 1 is repeated
            if value.ndim != len(shape) or not all(map(operator.contains, lengths, value.shape)):
                row = f"one number, an array {shape[:1]} with a number for each row, or" if per_row and shape else ""
                raise Refused(
                    f"{name}[{body!r}] has shape {seen}, and the position has {shape}; give {row or 'an array of'} "
                    f"shape {shape}."
                )
            pieces.append(library(value).broadcast_to(value, shape).reshape(-1))
        return library(pieces).concatenate([*pieces, library(pieces).zeros(0)])


class Computed(str):
    """Key of a parameter that is computed from numbers of which a system has other copies, such as the mass in the
    weight of a body.

    A change of this parameter alone belongs to no scene, see `check_computed`.
    """

    __slots__ = ()


def leaves_by_name(tree: Any) -> tuple[dict[str, Any], Any]:
    """The leaves of a pytree of parameters by their names, ``springs.stiffness``, and its structure.

    The name of a leaf is `Computed` if one of its keys is.
    """
    leaves, structure = jax.tree.flatten_with_path(tree)
    names = (jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in leaves)
    computed = (any(isinstance(getattr(key, "key", None), Computed) for key in path) for path, _ in leaves)
    kept = (Computed(name) if is_computed else name for name, is_computed in zip(names, computed, strict=True))
    return {name: leaf for name, (_, leaf) in zip(kept, leaves, strict=True)}, structure


def free(names: Iterable[str]) -> list[str]:
    """The names of parameters that may be changed alone."""
    return [name for name in names if not isinstance(name, Computed)]


def check_computed(params: Any, changed: Any) -> None:
    """Refuse params of a system whose `Computed` numbers are changed; a leading axis of lanes with equal numbers
    changes nothing.

    Where all numbers are traced, as in the derivative with respect to all params, nothing shows whether they change.
    """
    leaves, _ = leaves_by_name(changed)
    if not any(map(is_concrete, leaves.values())):
        return
    for name, old in leaves_by_name(params)[0].items():
        new = leaves.get(name, old)
        if not isinstance(name, Computed) or new is old or not is_concrete(old):
            continue
        fits = is_concrete(new) and np.shape(new)[np.ndim(new) - np.ndim(old) :] == np.shape(old)
        if not (fits and np.all(np.asarray(new) == np.asarray(old))):
            raise Refused(
                f"params: {name} is {new}, and the system has {old}: the scene computes this number from its bodies "
                "and from fields of its effects, and has other copies of these. Make a scene with other bodies or "
                "fields instead, one for each value; jax.jit, grad and vmap may trace them, if every body has a pace "
                "and every potential a rate."
            )

"""Checks of plain data that a user wrote. Messages tell the place, the value, and the expected form."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from vmri_jax.mechanics.names import near
from vmri_jax.refusals import Refused


def check_keys(data: Any, needed: Sequence[str], optional: Sequence[str], where: str) -> None:
    """Refuse data that is no dict, unknown entries, and missing entries."""
    known = (*needed, *optional)
    if not isinstance(data, dict):
        raise Refused(f"{where} is {type(data).__name__}; it must be a dict with {', '.join(known)}.")
    for key in data:
        if key not in known:
            raise Refused(f"{where} has no entry {key!r}.{near(str(key), known)} There are {', '.join(known)}.")
    for key in needed:
        if key not in data:
            raise Refused(f"{where} lacks the entry {key!r}.")


def entries(data: dict, key: str, where: str) -> list:
    """The list at a key, empty if the key is missing."""
    items = data.get(key, [])
    if not isinstance(items, list | tuple):
        raise Refused(f"{where}: {key} is {type(items).__name__}; it must be a list.")
    return list(items)


def _floats(value: Any) -> np.ndarray:
    """An array of floats, of one NaN where the value is no array of numbers."""
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        return np.array(np.nan)


def numbers(value: Any, where: str) -> tuple[float, ...]:
    """1 to 3 finite numbers."""
    array = _floats(value)
    if array.ndim != 1 or not 1 <= array.size <= 3 or not np.isfinite(array).all():
        raise Refused(f"{where} is {value!r}; it must be a list of 1 to 3 finite numbers.")
    return tuple(array.tolist())


def direction(value: Any, where: str) -> tuple[float, ...]:
    """1 to 3 finite numbers that are not all zero."""
    vector = numbers(value, where)
    if not any(vector):
        raise Refused(f"{where} is {list(vector)}; it must not be zero.")
    return vector


def angles(value: Any, where: str) -> tuple[float, ...]:
    """Azimuth and elevation in degrees."""
    degrees = _floats(value)
    if degrees.shape != (2,) or not np.isfinite(degrees).all() or abs(degrees[1]) > 90:
        raise Refused(f"{where} is {value!r}; it must be azimuth and elevation in degrees, the latter from -90 to 90.")
    return tuple(degrees.tolist())


def positive(value: Any, where: str) -> float:
    """A positive number."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < np.inf:
        raise Refused(f"{where} is {value!r}; it must be a positive number.")
    return float(value)

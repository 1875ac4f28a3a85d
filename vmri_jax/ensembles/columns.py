"""Columns of a design by name: each sets a parameter, a part of the start, a step or the scheme of a run.

omega, springs.stiffness, masses[2]     a parameter of the system, or one number of it
q_s, v_f, ...                           a whole vector of the start
q_s[0], v_f[3], "hub x", "v hub x"      one coordinate of the start, or its velocity, by number or by name
t                                       the time of the start
macro_dt, micro_dt, num_steps           steps
num_micro, scheme                       schemes
"""

import re
from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from vmri_jax.ensembles.design import Rows
from vmri_jax.mechanics.names import Names, near
from vmri_jax.mechanics.state import Problem

STEPS = ("macro_dt", "micro_dt", "num_steps")
SCHEMES = ("scheme", "num_micro")
START = ("t", "q_s", "q_f", "v_s", "v_f")


class ColumnPlace(NamedTuple):
    """The numbers that a column replaces.

    part: "params", or the part of the start: t, q_s, q_f, v_s, v_f.
    leaf: number of the array among the parameters; 0 for a part of the start.
    index: of one number in the array, () for the whole array.
    """

    part: str
    leaf: int
    index: tuple[int, ...]


class Lanes(NamedTuple):
    """Runs side by side, the first axis of every array.

    params: of the structure of the system's parameters; None if no column changes a parameter.
    start: t, q_s, q_f, v_s, v_f by name.
    """

    params: Any
    start: dict[str, np.ndarray]


def places(problem: Problem, columns: Collection[str]) -> dict[str, ColumnPlace]:
    """The place of each column that sets a parameter or a part of the start.

    Raises:
        ValueError: a name that the problem does not have, an index that does not exist, or two columns for one number.
    """
    known = _known(problem)
    by_column: dict[str, ColumnPlace] = {}
    for name in columns:
        if name not in (*STEPS, *SCHEMES):
            by_column[name] = _place(name, problem, known)
    numbers: dict[tuple, str] = {}
    for name, place in by_column.items():
        for number in np.ndindex(*_target(problem, place).shape) if not place.index else [place.index]:
            first = numbers.setdefault((*place[:2], *number), name)
            if first != name:
                raise ValueError(f"ensemble: the columns {first!r} and {name!r} both give {_shown(place, number)}.")
    return by_column


def lanes_of(problem: Problem, where: Mapping[str, ColumnPlace], rows: Rows, count: int) -> Lanes:
    """Parameters and starts of some runs.

    Args:
        problem: has the values that no column changes.
        where: the place of each column, see `places`.
        rows: the values of the columns.
        count: number of runs.

    Raises:
        ValueError: values of another shape than the numbers that they replace.
    """
    leaves, structure = jax.tree.flatten(problem.system.params)
    start = {name: _repeated(getattr(problem, name), count) for name in START}
    params = None
    if any(place.part == "params" for place in where.values()):
        params = [_repeated(leaf, count) for leaf in leaves]
    for name, place in where.items():
        target = start[place.part] if params is None or place.part != "params" else params[place.leaf]
        shape = target[:, *place.index].shape
        if rows[name].shape != shape or rows[name].dtype.kind not in "if":
            raise ValueError(
                f"ensemble: each value of {name!r} has the shape {rows[name].shape[1:]}; it must be numbers of shape {shape[1:]}."
            )
        target[:, *place.index] = rows[name]
    return Lanes(None if params is None else jax.tree.unflatten(structure, params), start)


def _repeated(value, count: int) -> np.ndarray:
    """(count, ...) copies of an array."""
    value = np.asarray(value, dtype=float)
    return np.repeat(value[None], count, axis=0)


def _known(problem: Problem) -> dict[str, Callable[[tuple[int, ...]], ColumnPlace]]:
    """For each name of a column, a function that gives its place from an index."""
    known: dict[str, Callable] = {}
    paths, _ = jax.tree_util.tree_flatten_with_path(problem.system.params)
    for leaf, (path, _) in enumerate(paths):
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        known[name or "params"] = lambda index, leaf=leaf: ColumnPlace("params", leaf, index)
    names = (problem.names or Names()).of_coordinates(problem.q_s.size, problem.q_f.size)
    for part, labels in (("s", names.slow_coordinates), ("f", names.fast_coordinates)):
        for i, label in enumerate(labels):
            known.setdefault(label, lambda _, part=part, i=i: ColumnPlace(f"q_{part}", 0, (i,)))
            known.setdefault(f"v {label}", lambda _, part=part, i=i: ColumnPlace(f"v_{part}", 0, (i,)))
    for part in START:
        known.setdefault(part, lambda index, part=part: ColumnPlace(part, 0, index))
    return known


def _place(name: str, problem: Problem, known: Mapping[str, Callable]) -> ColumnPlace:
    if name in known:
        return known[name](())
    match = re.fullmatch(r"(.+)\[(\d+(?:,\s*\d+)*)\]", name)
    if match is None or match[1] not in known:
        listed = [n for n in known if n not in START and not re.fullmatch(r"(v )?q_[sf]\[\d+\]", n)]
        raise ValueError(
            f"ensemble: the column {name!r} is no parameter, coordinate, step or scheme.{near(name, [*known, *STEPS, *SCHEMES])} There are "
            f"{', '.join([*listed, *START[1:], *STEPS, *SCHEMES])}. One number of an array is {START[1]}[0], for example."
        )
    place = known[match[1]](tuple(int(i) for i in match[2].split(",")))
    shape = _target(problem, place).shape
    if len(place.index) != len(shape) or any(i >= n for i, n in zip(place.index, shape, strict=True)):
        raise ValueError(
            f"ensemble: the column {name!r} has an index that {match[1]}, of shape {shape}, does not have."
        )
    return place


def _target(problem: Problem, place: ColumnPlace) -> np.ndarray:
    """The array of the problem that the place is in."""
    if place.part != "params":
        return np.asarray(getattr(problem, place.part))
    return np.asarray(jax.tree.leaves(problem.system.params)[place.leaf])


def _shown(place: ColumnPlace, number) -> str:
    target = "a parameter" if place.part == "params" else place.part
    return f"{target}{list(number) if len(number) else ''}"

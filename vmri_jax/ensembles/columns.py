"""Columns of a design: a function ``(problem, row) -> problem`` makes the problem of a run.

Without such a function the name of a column says which number it sets:

omega, springs.stiffness, masses[2]     a parameter of the system, or one number of it
q_s, v_f, ...                           a whole vector of the start
q_s[0], v_f[3], "hub x", "v hub x"      one coordinate of the start, or its velocity, by number or by name
t                                       the time of the start
macro_dt, micro_dt, num_steps           steps
num_micro, scheme                       schemes
"""

import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.ensembles.design import Rows
from vmri_jax.mechanics.checks import check_type, is_concrete
from vmri_jax.mechanics.names import Names, near
from vmri_jax.mechanics.state import Problem
from vmri_jax.mechanics.system import System

STEPS = ("macro_dt", "micro_dt", "num_steps")
SCHEMES = ("scheme", "num_micro")
START = ("t", "q_s", "q_f", "v_s", "v_f")

Row = Mapping[str, Any]
"""The value of each column in a row of a design."""
Vary = Callable[[Problem, Row], Problem]
"""A function that makes the problem of a run from a problem and a row."""


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

    params: of the structure of the system's parameters; None if no row changes a parameter.
    start: t, q_s, q_f, v_s, v_f.
    """

    params: Any
    start: tuple[Any, ...]


def by_name(problem: Problem, columns: Collection[str]) -> Vary:
    """The function ``(problem, row) -> problem`` that puts the value of each column in the place that its name says.

    Raises:
        ValueError: a name that the problem does not have, an index that does not exist, or two columns for one number.
    """
    known, places = _known(problem), {}
    numbers: dict[tuple, str] = {}
    for name in columns:
        places[name] = place = _place(name, problem, known)
        for number in np.ndindex(*_target(problem, place).shape) if not place.index else [place.index]:
            first = numbers.setdefault((*place[:2], *number), name)
            if first != name:
                raise ValueError(f"ensemble: the columns {first!r} and {name!r} both give {_shown(place, number)}.")

    def vary(problem: Problem, row: Row) -> Problem:
        leaves, structure = jax.tree.flatten(problem.system.params)
        start = {part: getattr(problem, part) for part in START}
        for name, place in places.items():
            arrays, key = (leaves, place.leaf) if place.part == "params" else (start, place.part)
            arrays[key] = _with_number(arrays[key], place.index, name, row[name])
        if any(place.part == "params" for place in places.values()):
            start["system"] = problem.system.replace(params=jax.tree.unflatten(structure, leaves))
        return replace(problem, **start)

    return vary


def _with_number(array, index: tuple[int, ...], name: str, value):
    """The array with the value of a column at an index.

    Raises:
        ValueError: the value has another shape than the numbers that it replaces.
    """
    array = jnp.asarray(array, dtype=float)
    shape = array.shape[len(index) :]
    if np.shape(value) != shape:
        raise ValueError(
            f"ensemble: each value of {name!r} has the shape {np.shape(value)}; it must be numbers of shape {shape}."
        )
    return array.at[index].set(value)


def numbers_in(rows: Rows) -> Rows:
    """The columns of numbers that change the problem; steps and schemes are left out.

    Raises:
        ValueError: a column of labels.
    """
    columns = {name: values for name, values in rows.items() if name not in (*STEPS, *SCHEMES)}
    for name, values in columns.items():
        if values.dtype.kind not in "if":
            raise ValueError(
                f"ensemble: the column {name!r} has labels; only the column 'scheme' may have them. Give numbers."
            )
    return columns


def lane_function(problem: Problem, vary: Vary, columns: Collection[str]) -> Callable[[Row], Lanes]:
    """The function from a row to the parameters and the start of its run.

    Args:
        columns: names of the columns that change the problem, in their order in the design; JAX would sort them.

    Raises (when it is called):
        TypeError: `vary` returns no problem.
        ValueError: `vary` changes something else than the values of parameters and the start.
    """

    def lane(row: Row) -> Lanes:
        changed = vary(problem, {name: row[name] for name in columns})
        check_type(
            "ensemble: vary(problem, row)", changed, Problem, "dataclasses.replace(problem, q_s=...), for example"
        )
        _check_only_values_differ(problem, changed)
        is_same = changed.system.params is problem.system.params
        return Lanes(None if is_same else changed.system.params, tuple(getattr(changed, part) for part in START))

    return lane


def _check_only_values_differ(problem: Problem, changed: Problem) -> None:
    """Refuse a row whose run the program of the problem cannot compute: another system but for parameters, or arrays of other shapes."""
    same_system = _is_same(problem.system.replace(params=None), changed.system.replace(params=None))
    before, after = ((entry.system.params, [getattr(entry, part) for part in START]) for entry in (problem, changed))
    if not same_system or jax.tree.map(np.shape, before) != jax.tree.map(np.shape, after):
        raise ValueError(
            "ensemble: vary(problem, row) may change the values of system.params, positions, velocities and t. It changes "
            f"{'the structure or shape of one of them' if same_system else 'the system besides its params'}; such runs need an ensemble of their own."
        )


def _is_same(before: System, after: System) -> bool:
    """Whether two systems have the same functions and the same arrays."""
    leaves, structure = jax.tree.flatten(before)
    other_leaves, other_structure = jax.tree.flatten(after)
    return structure == other_structure and all(
        a is b or (is_concrete(b) and np.array_equal(a, b)) for a, b in zip(leaves, other_leaves, strict=True)
    )


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

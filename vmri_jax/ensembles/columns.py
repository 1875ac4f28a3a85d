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

STEPS = ("macro_dt", "micro_dt", "num_steps")
SCHEMES = ("scheme", "num_micro")
START = ("t", "q_s", "q_f", "v_s", "v_f")

Row = Mapping[str, Any]
"""The value of each column in a row of a design."""
Vary = Callable[[Problem, Row], Problem]
"""A function that makes the problem of a run from a problem and a row."""
Lanes = tuple[Any, tuple[Any, ...]]
"""Parameters of the structure of the system's, None if no row changes one, and starts (t, q_s, q_f, v_s, v_f); in runs side by side the first
axis of every array."""


class ColumnPlace(NamedTuple):
    """The numbers that a column replaces.

    leaf: number of the array among the `_arrays` of the problem.
    index: of one number in the array, () for the whole array.
    """

    leaf: int
    index: tuple[int, ...] = ()


def by_name(problem: Problem, columns: Collection[str]) -> Vary:
    """The function ``(problem, row) -> problem`` that puts the value of each column in the place that its name says."""
    arrays, _ = _arrays(problem)
    num_params = len(arrays) - len(START)
    known = _known(problem)
    places = {name: _place(name, arrays, known) for name in columns}
    owners: dict[tuple, str] = {}
    for name, (leaf, index) in places.items():
        for number in [index] if index else np.ndindex(np.shape(arrays[leaf])):
            first = owners.setdefault((leaf, *number), name)
            if first != name:
                array = "a parameter" if leaf < num_params else START[leaf - num_params]
                raise ValueError(
                    f"ensemble: the columns {first!r} and {name!r} both give {array}{list(number) if number else ''}."
                )
    changes_params = any(place.leaf < num_params for place in places.values())

    def vary(problem: Problem, row: Row) -> Problem:
        leaves, structure = _arrays(problem)
        for name, place in places.items():
            leaves[place.leaf] = _with_number(leaves[place.leaf], place.index, name, row[name])
        params, start = jax.tree.unflatten(structure, leaves)
        system = problem.system.replace(params=params) if changes_params else problem.system
        return replace(problem, system=system, **dict(zip(START, start, strict=True)))

    return vary


def _arrays(problem: Problem) -> tuple[list, Any]:
    """The arrays that columns can change, the parameters and then the parts of the start, and their structure."""
    return jax.tree.flatten((problem.system.params, [getattr(problem, part) for part in START]))


def _with_number(array, index: tuple[int, ...], name: str, value):
    """The array with the value of a column at an index."""
    array = jnp.asarray(array, dtype=float)
    shape = array.shape[len(index) :]
    if np.shape(value) != shape:
        raise ValueError(
            f"ensemble: each value of {name!r} has the shape {np.shape(value)}; it must be numbers of shape {shape}."
        )
    return array.at[index].set(value)


def numbers_in(rows: Rows) -> Rows:
    """The columns of numbers that change the problem; steps and schemes are left out."""
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
        return None if is_same else changed.system.params, tuple(getattr(changed, part) for part in START)

    return lane


def _check_only_values_differ(problem: Problem, changed: Problem) -> None:
    """Refuse a row whose run the program of the problem cannot compute: another system but for parameters, or arrays of other shapes."""
    leaves, structure = jax.tree.flatten(problem.system.replace(params=None))
    new_leaves, new_structure = jax.tree.flatten(changed.system.replace(params=None))
    same_system = structure == new_structure and all(
        a is b or (is_concrete(b) and np.array_equal(a, b)) for a, b in zip(leaves, new_leaves, strict=True)
    )
    before, after = ((entry.system.params, [getattr(entry, part) for part in START]) for entry in (problem, changed))
    same_shapes = jax.tree.map(np.shape, before) == jax.tree.map(np.shape, after)
    if not (same_system and same_shapes):
        raise ValueError(
            "ensemble: vary(problem, row) may change the values of system.params, positions, velocities and t. It changes "
            f"{'the system besides its params' if same_shapes else 'the structure or shape of one of them'}; such runs need an ensemble of their own."
        )


def _known(problem: Problem) -> dict[str, ColumnPlace]:
    """The place of each name of a column, in order: parameters, coordinates and their velocities, parts of the start."""
    paths, _ = jax.tree_util.tree_flatten_with_path(problem.system.params)
    leaf_names = [jax.tree_util.keystr(path, simple=True, separator=".") or "params" for path, _ in paths]
    known = {name: ColumnPlace(leaf) for leaf, name in enumerate(leaf_names)}
    parts = {part: ColumnPlace(len(paths) + i) for i, part in enumerate(START)}
    names = (problem.names or Names()).of_coordinates(problem.q_s.size, problem.q_f.size)
    for part, labels in (("s", names.slow_coordinates), ("f", names.fast_coordinates)):
        for i, label in enumerate(labels):
            known.setdefault(label, parts[f"q_{part}"]._replace(index=(i,)))
            known.setdefault(f"v {label}", parts[f"v_{part}"]._replace(index=(i,)))
    for part, place in parts.items():
        known.setdefault(part, place)
    return known


def _place(name: str, arrays: list, known: Mapping[str, ColumnPlace]) -> ColumnPlace:
    if name in known:
        return known[name]
    match = re.fullmatch(r"(.+)\[(\d+(?:,\s*\d+)*)\]", name)
    if match is None or match[1] not in known or known[match[1]].index:
        listed = [n for n in known if n not in START and not re.fullmatch(r"(v )?q_[sf]\[\d+\]", n)]
        raise ValueError(
            f"ensemble: the column {name!r} is no parameter, coordinate, step or scheme.{near(name, [*known, *STEPS, *SCHEMES])} There are "
            f"{', '.join([*listed, *START[1:], *STEPS, *SCHEMES])}. One number of an array is {START[1]}[0], for example."
        )
    place = ColumnPlace(known[match[1]].leaf, tuple(int(i) for i in match[2].split(",")))
    shape = np.shape(arrays[place.leaf])
    if len(place.index) != len(shape) or any(i >= n for i, n in zip(place.index, shape, strict=True)):
        raise ValueError(
            f"ensemble: the column {name!r} has an index that {match[1]}, of shape {shape}, does not have."
        )
    return place

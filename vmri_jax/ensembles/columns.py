"""What the columns of a design stand for: parameters, the start, steps and schemes of a run.

omega, springs.stiffness, masses[2]     numbers in the parameters of the system
q_s, v_f, ...                           the whole start, vectors
q_s[0], v_f[3], "hub x", "v hub x"      one coordinate of it, or its velocity, by number or by name
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


class Place(NamedTuple):
    """Numbers that a column replaces: those of `leaf` of the parameters, or of a part of the start, at `index`."""

    part: str
    leaf: int
    index: tuple[int, ...]


class Lanes(NamedTuple):
    """Runs side by side, the first axis of every array.

    params: like the parameters of the system, None if no column changes them.
    start: t, q_s, q_f, v_s, v_f.
    """

    params: Any
    start: dict[str, np.ndarray]


def places(problem: Problem, columns: Collection[str]) -> dict[str, Place]:
    """Where the columns belong that are neither steps nor schemes.

    Raises:
        ValueError: a name that is nothing of this problem, an index that does not exist, or two columns for one number.
    """
    known = _known(problem)
    found: dict[str, Place] = {}
    for name in columns:
        if name not in (*STEPS, *SCHEMES):
            found[name] = _place(name, problem, known)
    numbers: dict[tuple, str] = {}
    for name, place in found.items():
        for number in np.ndindex(*_target(problem, place).shape) if not place.index else [place.index]:
            other = numbers.setdefault((*place[:2], *number), name)
            if other != name:
                raise ValueError(f"ensemble: the columns {other!r} and {name!r} both give {_shown(place, number)}.")
    return found


def lanes_of(problem: Problem, where: Mapping[str, Place], rows: Rows, count: int) -> Lanes:
    """Parameters and starts of some runs.

    Args:
        problem: what is the same for all of them.
        where: the columns, see `places`.
        rows: their values.
        count: number of runs.

    Raises:
        ValueError: values of another shape than what they replace.
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
    value = np.asarray(value, dtype=float)
    return np.repeat(value[None], count, axis=0)


def _known(problem: Problem) -> dict[str, Callable[[tuple[int, ...]], Place]]:
    """Names of columns, and the place of each for an index."""
    found: dict[str, Callable] = {}
    paths, _ = jax.tree_util.tree_flatten_with_path(problem.system.params)
    for leaf, (path, _) in enumerate(paths):
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        found[name or "params"] = lambda index, leaf=leaf: Place("params", leaf, index)
    names = (problem.names or Names()).of_coordinates(problem.q_s.size, problem.q_f.size)
    for part, labels in (("s", names.slow_coordinates), ("f", names.fast_coordinates)):
        for i, label in enumerate(labels):
            found.setdefault(label, lambda _, part=part, i=i: Place(f"q_{part}", 0, (i,)))
            found.setdefault(f"v {label}", lambda _, part=part, i=i: Place(f"v_{part}", 0, (i,)))
    for part in START:
        found.setdefault(part, lambda index, part=part: Place(part, 0, index))
    return found


def _place(name: str, problem: Problem, known: Mapping[str, Callable]) -> Place:
    if name in known:
        return known[name](())
    match = re.fullmatch(r"(.+)\[(\d+(?:,\s*\d+)*)\]", name)
    if match is None or match[1] not in known:
        listed = [n for n in known if n not in START and not re.fullmatch(r"(v )?q_[sf]\[\d+\]", n)]
        raise ValueError(
            f"ensemble: there is nothing that the column {name!r} could change.{near(name, [*known, *STEPS, *SCHEMES])} There are "
            f"{', '.join([*listed, *START[1:], *STEPS, *SCHEMES])}; of arrays one number, {START[1]}[0]."
        )
    place = known[match[1]](tuple(int(i) for i in match[2].split(",")))
    shape = _target(problem, place).shape
    if len(place.index) != len(shape) or any(i >= n for i, n in zip(place.index, shape, strict=True)):
        raise ValueError(
            f"ensemble: the column {name!r} has an index that {match[1]}, of shape {shape}, does not have."
        )
    return place


def _target(problem: Problem, place: Place) -> np.ndarray:
    """The numbers of the problem, some of which the column replaces."""
    if place.part != "params":
        return np.asarray(getattr(problem, place.part))
    return np.asarray(jax.tree.leaves(problem.system.params)[place.leaf])


def _shown(place: Place, number) -> str:
    what = "a parameter" if place.part == "params" else place.part
    return f"{what}{list(number) if len(number) else ''}"

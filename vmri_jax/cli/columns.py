"""Names of columns in sweep files: each says which number of a problem it sets.

omega, springs.stiffness, masses[2]     a parameter of the system, or one number of it
q_s[0], v_f[3], "hub x", "v hub x"      one coordinate of the start, or its velocity, by number or by name
t                                       the time of the start
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.ensembles.columns import SCHEMES, START, STEPS, Row, columns_of_problems
from vmri_jax.mechanics.names import Names, near
from vmri_jax.mechanics.slots import free, leaves_by_name
from vmri_jax.mechanics.state import Problem
from vmri_jax.refusals import Refused

Place = tuple[int, tuple[int, ...]]
"""Number of an array among the `_arrays` of a problem, and the index of a number in it."""


@dataclass(frozen=True)
class ByName:
    """A function ``(problem, row) -> problem`` that puts each value in its place, and that pickle can send."""

    places: dict[str, Place]

    def __call__(self, problem: Problem, row: Row) -> Problem:
        arrays, structure = _arrays(problem)
        changed = {number for number, _ in self.places.values()}
        for name, (number, index) in self.places.items():
            arrays[number] = jnp.asarray(arrays[number], dtype=float).at[index].set(row[name])
        params, start = jax.tree.unflatten(structure, arrays)
        sets_params = min(changed) < len(arrays) - len(START)
        system = problem.system.replace(params=params) if sets_params else problem.system
        return replace(problem, system=system, **dict(zip(START, start, strict=True)))


def by_name(problem: Problem, columns: Sequence[str]) -> ByName | None:
    """The function that sets the numbers which columns name; None where all columns are steps and schemes."""
    known, places = _known(problem), {}
    for name in columns_of_problems(columns):
        if name not in known:
            listed = [other for other in free(known) if "[" not in other]
            raise Refused(
                f"the column {name!r} sets no number of the problem.{near(name, [*known, *STEPS, *SCHEMES])} There are "
                f"{', '.join([*listed, *STEPS, *SCHEMES])}, and numbers of arrays, {START[1]}[0] for example."
            )
        twice = [other for other, place in places.items() if place == known[name]]
        if twice:
            raise Refused(f"the columns {twice[0]!r} and {name!r} set the same number; leave one of them out.")
        places[name] = known[name]
    return ByName(places) if places else None


def _arrays(problem: Problem) -> tuple[list, Any]:
    """The arrays that columns can change, the parameters and then the parts of the start, and their structure."""
    return jax.tree.flatten((problem.system.params, [getattr(problem, part) for part in START]))


def _known(problem: Problem) -> dict[str, Place]:
    """The place of every number by its names; a parameter goes before a coordinate of the same name."""
    labels = [name or "params" for name in leaves_by_name(problem.system.params)[0]]
    arrays, _ = _arrays(problem)
    known: dict[str, Place] = {}
    for number, (label, array) in enumerate(zip([*labels, *START], arrays, strict=True)):
        for index in np.ndindex(np.shape(array)):
            known.setdefault(f"{label}[{','.join(map(str, index))}]" if index else label, (number, index))
    names = (problem.names or Names()).of_coordinates(problem.q_s.size, problem.q_f.size)
    for part, coordinates in (("s", names.slow_coordinates), ("f", names.fast_coordinates)):
        for i, name in enumerate(coordinates):
            known.setdefault(name, known[f"q_{part}[{i}]"])
            known.setdefault(f"v {name}", known[f"v_{part}[{i}]"])
    return known

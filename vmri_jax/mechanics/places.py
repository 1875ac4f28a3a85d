"""The numbers of a problem by name, for columns of sweep files and for unknown parameters of a fit.

omega, springs.stiffness, masses[2]     a parameter of the system, or one number of it
q_s, v_f[3], "hub x", "v hub x"         a part of the start, or one coordinate or velocity, by number or by name
t                                       the time of the start
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.names import Names
from vmri_jax.mechanics.slots import leaves_by_name
from vmri_jax.mechanics.state import Problem

START = ("t", "q_s", "q_f", "v_s", "v_f")
Index = tuple[int, tuple[int, ...]]
"""Number of an array among the `_arrays` of a problem, and the index of a number in it, () for the whole array."""


@dataclass(frozen=True)
class Placed:
    """A function ``(problem, values) -> problem`` that puts each value in the place of its name, and that pickle can
    send."""

    places: dict[str, Index]

    def __call__(self, problem: Problem, values: Mapping[str, Any]) -> Problem:
        arrays, structure = _arrays(problem)
        for name, (number, index) in self.places.items():
            arrays[number] = jnp.asarray(arrays[number], dtype=float).at[index].set(values[name])
        params, start = jax.tree.unflatten(structure, arrays)
        sets_params = any(number < len(arrays) - len(START) for number, _ in self.places.values())
        system = problem.system.replace(params=params) if sets_params else problem.system
        return replace(problem, system=system, **dict(zip(START, start, strict=True)))


def _arrays(problem: Problem) -> tuple[list, Any]:
    """The arrays that may be set, the parameters and then the parts of the start, and their structure."""
    return jax.tree.flatten((problem.system.params, [getattr(problem, part) for part in START]))


def places_of(problem: Problem) -> dict[str, tuple[Index, tuple[int, ...]]]:
    """The place and the shape of all arrays and all numbers by name; a parameter goes before a coordinate of the same
    name."""
    labels = [name or "params" for name in leaves_by_name(problem.system.params)[0]]
    known: dict[str, tuple[Index, tuple[int, ...]]] = {}
    for number, (label, array) in enumerate(zip([*labels, *START], _arrays(problem)[0], strict=True)):
        known.setdefault(label, ((number, ()), np.shape(array)))
        for index in np.ndindex(np.shape(array)):
            known.setdefault(f"{label}[{','.join(map(str, index))}]", ((number, index), ()))
    names = (problem.names or Names()).of_coordinates(problem.q_s.size, problem.q_f.size)
    for part, coordinates in (("s", names.slow_coordinates), ("f", names.fast_coordinates)):
        for i, name in enumerate(coordinates):
            known.setdefault(name, known[f"q_{part}[{i}]"])
            known.setdefault(f"v {name}", known[f"v_{part}[{i}]"])
    return known

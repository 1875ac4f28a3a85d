"""Columns of a design: a function ``(problem, row) -> problem`` makes the problem of a run from the values of its row.

Columns with these names choose steps and schemes instead: macro_dt, num_steps, num_micro, scheme.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from vmri_jax.ensembles.design import Rows
from vmri_jax.mechanics.checks import check_type, is_concrete
from vmri_jax.mechanics.names import near
from vmri_jax.mechanics.state import Problem
from vmri_jax.refusals import Refused

STEPS = ("macro_dt", "num_steps")
SCHEMES = ("scheme", "num_micro")
START = ("t", "q_s", "q_f", "v_s", "v_f")

Row = Mapping[str, Any]
"""The value of each column in a row of a design."""
Vary = Callable[[Problem, Row], Problem]
"""A function that makes the problem of a run from a problem and a row."""
Lanes = tuple[Any, tuple[Any, ...]]
"""Parameters of the structure of the system's, None if no row changes one, and starts (t, q_s, q_f, v_s, v_f); in runs side by side the first
axis of every array."""


def columns_of_problems(columns: Sequence[str]) -> list[str]:
    """The columns that choose neither steps nor schemes."""
    return [name for name in columns if name not in (*STEPS, *SCHEMES)]


def numbers_in(rows: Rows) -> Rows:
    """The columns of numbers that change the problem; steps and schemes are left out."""
    columns = {name: rows[name] for name in columns_of_problems(list(rows))}
    for name, values in columns.items():
        if values.dtype.kind not in "if":
            raise Refused(f"ensemble: the column {name!r} has labels; give numbers. Only 'scheme' may have labels.")
    return columns


def lane_function(
    problem: Problem, vary: Vary | None, columns: Sequence[str], time_is_fixed: bool
) -> Callable[[Row], Lanes]:
    """The function from a row to the parameters and the start of its run; `columns` change the problem, in their order
    in the design, which JAX would sort. With `time_is_fixed` runs must start at the time of the problem."""
    if vary is None and columns:
        name = columns[0]
        known = near(name, (*STEPS, *SCHEMES))
        raise Refused(f"ensemble: the column {name!r} is neither a step nor a scheme.{known} Give vary= for it.")

    def lane(row: Row) -> Lanes:
        changed = problem if vary is None else vary(problem, {name: row[name] for name in columns})
        check_type("ensemble: vary(problem, row)", changed, Problem, "dataclasses.replace(problem, q_s=...)")
        _check_only_values_differ(problem, changed)
        if time_is_fixed and changed.t is not problem.t:
            raise Refused("ensemble: vary changes t, so that t_end does not fix the number of steps; give num_steps.")
        is_same = changed.system.params is problem.system.params
        return None if is_same else changed.system.params, tuple(getattr(changed, part) for part in START)

    return lane


def _check_only_values_differ(problem: Problem, changed: Problem) -> None:
    """Refuse a row whose run the program of the problem cannot compute: another system but for parameters, or arrays of other shapes."""
    leaves, structure = jax.tree.flatten(problem.system.replace(params=None))
    new_leaves, new_structure = jax.tree.flatten(changed.system.replace(params=None))
    are_equal = (a is b or (is_concrete(b) and np.array_equal(a, b)) for a, b in zip(leaves, new_leaves, strict=False))
    same_system = structure == new_structure and all(are_equal)
    before, after = ((entry.system.params, [getattr(entry, part) for part in START]) for entry in (problem, changed))
    same_shapes = jax.tree.map(np.shape, before) == jax.tree.map(np.shape, after)
    if not (same_system and same_shapes):
        changes = "the system besides its params" if same_shapes else "the structure or shape of one of them"
        raise Refused(f"ensemble: vary changes {changes}; it may change values of system.params and of the start.")

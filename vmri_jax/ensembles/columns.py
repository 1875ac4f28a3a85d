"""Columns of a design: a function ``(problem, row) -> problem`` makes the problem of a run from the values of its row.

Columns with these names choose steps and schemes instead: macro_dt, num_steps, num_micro, scheme.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from vmri_jax.ensembles.design import Rows
from vmri_jax.mechanics.state import Problem
from vmri_jax.refusals import Refused

STEPS = ("macro_dt", "num_steps")
SCHEMES = ("scheme", "num_micro")
START = ("t", "q_s", "q_f", "v_s", "v_f")

Row = Mapping[str, Any]
"""The value of each column in a row of a design."""
Vary = Callable[[Problem, Row], Problem]
"""A function that makes the problem of a run from a problem and a row."""


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

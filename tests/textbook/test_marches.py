"""Steps that are marched through, micro interval after micro interval, against the textbook."""

from typing import Any

import pytest

from tests.textbook.agreement import SPRINGS, assert_agrees
from tests.verification import random_systems as rs
from vmri_jax import Method, kernels

ROD: Any = {**SPRINGS, "constraint": "rod"}
HELD: Any = {**ROD, "slow_constraint": "norm"}
STRUCTURES = {
    "drift": rs.Structure(2, 1, 1, "matrix", **HELD, moving=True, scheme="fully explicit"),
    "masses": rs.Structure(2, 1, 2, "matrix", **HELD, scheme="fully explicit", num_micro=4),
    "march that moves": rs.Structure(2, 1, 1, **ROD, moving=True, force="drag", scheme="gauss", num_micro=2, degree=2),
    "march without constraints": rs.Structure(1, 1, 2, **SPRINGS, scheme="gauss", num_micro=2, degree=3),
    "many slow variables": rs.Structure(3, 8, 2, "matrix", **ROD, scheme="gauss", degree=2),
    "slow variables alone": rs.Structure(3, 9, 0, slow_potential="harmonic", scheme="gauss", degree=2),
    "modes": rs.Structure(2, 1, 1, "matrix", **HELD, moving=True, scheme="gauss", degree=3),
}


@pytest.mark.parametrize("name", STRUCTURES)
def test_steppers_solve_the_equations_of_the_textbook(name):
    has_modes = name == "modes" and kernels.COLLOCATES  # else steppers know no special cases
    assert_agrees(name, STRUCTURES[name], Method.MODES if has_modes else Method.MASSES)

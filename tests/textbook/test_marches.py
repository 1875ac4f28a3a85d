"""Steps that are marched through, micro interval after micro interval, against the textbook."""

import pytest

from tests.textbook.agreement import SPRINGS, assert_agrees
from tests.verification import random_systems as rs
from vmri_jax import Method, kernels

STRUCTURES = {
    "drift": (
        Method.MASSES,
        rs.Structure(
            2, 1, 1, "matrix", **SPRINGS, constraint="rod", moving=True, slow_constraint="norm", scheme="fully explicit"
        ),
    ),
    "masses": (
        Method.MASSES,
        rs.Structure(
            2, 1, 2, "matrix", **SPRINGS, constraint="rod", slow_constraint="norm", scheme="fully explicit", num_micro=4
        ),
    ),
    "march that moves": (
        Method.MASSES,
        rs.Structure(
            2, 1, 1, **SPRINGS, constraint="rod", moving=True, force="drag", scheme="gauss", num_micro=2, degree=2
        ),
    ),
    "march without constraints": (
        Method.MASSES,
        rs.Structure(1, 1, 2, **SPRINGS, scheme="gauss", num_micro=2, degree=3),
    ),
    "many slow variables": (
        Method.MASSES,
        rs.Structure(3, 8, 2, "matrix", **SPRINGS, constraint="rod", scheme="gauss", degree=2),
    ),
    "slow variables alone": (Method.MASSES, rs.Structure(3, 9, 0, slow_potential="harmonic", scheme="gauss", degree=2)),
    "modes": (
        Method.MODES,
        rs.Structure(
            2,
            1,
            1,
            "matrix",
            **SPRINGS,
            constraint="rod",
            moving=True,
            slow_constraint="norm",
            scheme="gauss",
            degree=3,
        ),
    ),
}


@pytest.mark.parametrize("name", STRUCTURES)
def test_steppers_solve_the_equations_of_the_textbook(name):
    method, structure = STRUCTURES[name]
    if not kernels.COLLOCATES:  # steppers know no special cases
        method = Method.MASSES
    assert_agrees(name, structure, method)

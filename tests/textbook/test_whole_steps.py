"""Steps whose unknowns are solved for at once, against the textbook."""

from random import Random
from typing import Any

import pytest

from tests.textbook.agreement import SPRINGS, agrees, assert_agrees
from tests.verification import random_systems as rs
from vmri_jax import Method

HELD: Any = {**SPRINGS, "constraint": "rod", "moving": True, "slow_constraint": "norm"}
EXACT = rs.Structure(1, 2, 2, **SPRINGS, force="drag", scheme="gauss", num_micro=3, degree=3, method="exact")
NULL_SPACE = rs.Structure(2, 1, 2, "matrix", **HELD, scheme="gauss", num_micro=2, method="null_space")
OWN: Any = {"force": "drive", "scheme": "mixed", "num_micro": 2, "degree": 2, "method": "dense"}
STRUCTURES = {
    "exact": (Method.EXACT, EXACT),
    "kinetic function and all else": (Method.MASSES, rs.Structure(2, 1, 1, "bent", **HELD, force="drag", num_micro=2)),
    "the same, joined": (Method.MASSES, rs.Structure(2, 1, 1, "bent", **HELD, force="drag", num_micro=1)),
    "null space": (Method.NULL_SPACE, NULL_SPACE),
    "own rules": (Method.EXACT, rs.Structure(1, 1, 2, "coupled", **SPRINGS, **OWN)),
}


@pytest.mark.parametrize("name", STRUCTURES)
def test_steppers_solve_the_equations_of_the_textbook(name):
    method, structure = STRUCTURES[name]
    assert_agrees(name, structure, method)


def test_a_correction_by_multipliers_that_the_rest_cancels():
    """Its sum is small before the multipliers have converged: the second step ended 1e-11 too early."""
    structure = rs.structure(Random("0 tame structure 54"), tame=True)
    agrees(structure, rs.tame_draw(Random("0 tame draw 270"), structure))


@pytest.mark.full
@pytest.mark.parametrize("number", range(100))
def test_random_systems_follow_the_textbook(number):
    """Five systems of each random structure."""
    structure = rs.structure(Random(f"0 tame structure {number}"), tame=True)
    for draw in range(5):
        agrees(structure, rs.tame_draw(Random(f"0 tame draw {5 * number + draw}"), structure))

"""Explicit steps, linear ones, and slow and fast variables that go their own ways, against the textbook."""

from random import Random

import pytest

from tests.textbook.agreement import SPRINGS, assert_agrees
from tests.verification import random_systems as rs
from vmri_jax import Method, textbook

STRUCTURES = {
    "explicit": (Method.EXPLICIT, rs.Structure(2, 1, 2, **SPRINGS, scheme="fully explicit", num_micro=5)),
    "corrected kicks": (Method.EXPLICIT, rs.Structure(2, 1, 1, **SPRINGS, scheme="takahashi imada", num_micro=2)),
    "linear": (
        Method.LINEAR,
        rs.Structure(2, 1, 2, "matrix", "harmonic", "harmonic", scheme="explicit slow", num_micro=3),
    ),
    "slow and fast apart": (
        Method.MASSES,
        rs.Structure(
            2, 1, 2, **SPRINGS, constraint="anchored", slow_constraint="sphere", scheme="explicit slow", num_micro=3
        ),
    ),
    "composition": (
        Method.MASSES,
        rs.Structure(
            2,
            1,
            1,
            **SPRINGS,
            constraint="rod",
            moving=True,
            scheme="fully explicit",
            num_micro=2,
            composition="yoshida4",
        ),
    ),
}


@pytest.mark.parametrize("name", STRUCTURES)
def test_steppers_solve_the_equations_of_the_textbook(name):
    method, structure = STRUCTURES[name]
    assert_agrees(name, structure, method)


def test_textbook_leaves_mollified_kicks_out():
    structure = rs.Structure(scheme="mollified impulse", num_micro=2)
    draw = rs.tame_draw(Random(0), structure)
    problem = rs.problem(structure, draw)
    with pytest.raises(ValueError, match="mollified"):
        textbook.step(problem.system, rs.scheme(structure, draw), problem.state(), 0.1)

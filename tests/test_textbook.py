"""Every stepper against the textbook, on random systems."""

from random import Random
from typing import Any

import pytest

import vmri_jax as vm
from benchmarks import oracle
from tests.verification import random_systems as rs
from vmri_jax import textbook

SPRINGS: dict[str, Any] = {"slow_potential": "harmonic", "fast_potential": "spring"}
STRUCTURES = {
    "explicit": rs.Structure(2, 1, 2, **SPRINGS, scheme="fully explicit", num_micro=5),
    "corrected kicks": rs.Structure(2, 1, 1, **SPRINGS, scheme="takahashi imada", num_micro=2),
    "linear": rs.Structure(2, 1, 2, "matrix", "harmonic", "harmonic", scheme="explicit slow", num_micro=3),
    "drift": rs.Structure(
        2, 1, 1, "matrix", **SPRINGS, constraint="rod", moving=True, slow_constraint="norm", scheme="fully explicit"
    ),
    "slow and fast apart": rs.Structure(
        2, 1, 2, **SPRINGS, constraint="anchored", slow_constraint="sphere", scheme="explicit slow", num_micro=3
    ),
    "nested": rs.Structure(
        2, 1, 2, "matrix", **SPRINGS, constraint="rod", slow_constraint="norm", scheme="fully explicit", num_micro=4
    ),
    "march that moves": rs.Structure(
        2, 1, 1, **SPRINGS, constraint="rod", moving=True, scheme="gauss", num_micro=2, degree=2
    ),
    "march without constraints": rs.Structure(1, 1, 2, **SPRINGS, scheme="gauss", num_micro=2, degree=3),
    "collocation": rs.Structure(
        2, 1, 1, "matrix", **SPRINGS, constraint="rod", moving=True, slow_constraint="norm", scheme="gauss", degree=3
    ),
    "arrowhead": rs.Structure(
        1, 2, 2, **SPRINGS, force="drag", scheme="gauss", num_micro=3, degree=3, method="arrowhead"
    ),
    "kinetic function and all else": rs.Structure(
        2, 1, 1, "bent", **SPRINGS, constraint="rod", moving=True, slow_constraint="norm", force="drag", num_micro=2
    ),
    "null space": rs.Structure(
        2,
        1,
        2,
        "matrix",
        **SPRINGS,
        constraint="rod",
        moving=True,
        slow_constraint="norm",
        scheme="gauss",
        num_micro=2,
        degree=2,
        method="null_space",
    ),
    "own rules": rs.Structure(
        1, 1, 2, "coupled", **SPRINGS, force="drive", scheme="mixed", num_micro=2, degree=2, method="dense"
    ),
    "composition": rs.Structure(
        2, 1, 1, **SPRINGS, constraint="rod", moving=True, scheme="fully explicit", num_micro=2, composition="yoshida4"
    ),
}
METHODS = {
    "explicit": "EXPLICIT",
    "corrected kicks": "EXPLICIT",
    "linear": "LINEAR",
    "drift": "RATTLE",
    "slow and fast apart": "NESTED",
    "nested": "NESTED",
    "march that moves": "NESTED",
    "march without constraints": "NESTED",
    "collocation": "COLLOCATION",
    "arrowhead": "ARROWHEAD",
    "kinetic function and all else": "ARROWHEAD",
    "null space": "NULL_SPACE",
    "own rules": "DENSE",
    "composition": "NESTED",
}
"""The stepper that each of them is for."""
DRAWS = 4
"""Systems of each structure; they share its compiled programs."""
BOUND = 5e-12
"""Relative; the largest differences measured are 5e-13 (momenta) and 2e-14 (positions)."""


def agrees(structure, draw) -> str:
    """The method that solved the steps, if they end where the textbook's end."""
    found = oracle.compare(structure, draw)
    assert vm.Result[found.result].success
    assert max(found.positions, found.momenta) < BOUND
    return found.method


@pytest.mark.parametrize("name", STRUCTURES)
def test_steppers_solve_the_equations_of_the_textbook(name):
    structure = STRUCTURES[name]
    methods = {agrees(structure, rs.tame_draw(Random(f"{name} {i}"), structure)) for i in range(DRAWS)}
    assert methods == {METHODS[name]}


@pytest.mark.full
@pytest.mark.parametrize("first", range(0, 500, oracle.DRAWS))
def test_random_systems_follow_the_textbook(first):
    for number, structure, draw in oracle.systems(first + oracle.DRAWS, seed=0):
        if number >= first:
            agrees(structure, draw)


def test_textbook_leaves_mollified_kicks_out():
    structure = rs.Structure(scheme="mollified impulse", num_micro=2)
    draw = rs.tame_draw(Random(0), structure)
    problem = rs.problem(structure, draw)
    with pytest.raises(ValueError, match="mollified"):
        textbook.step(problem.system, rs.scheme(structure, draw), problem.state(), 0.1)

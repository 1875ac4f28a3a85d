"""Explicit steps, linear ones, and slow and fast variables that go their own ways, against the textbook."""

from random import Random
from typing import Any

import numpy as np
import pytest

import vmri_jax as vm
from benchmarks.gail2014.dense import named
from tests.textbook.agreement import BOUND, SPRINGS, STEPS, assert_agrees
from tests.textbook.residual import residual
from tests.verification import random_systems as rs
from vmri_jax import Method, textbook

HELD: Any = {"constraint": "anchored", "slow_constraint": "sphere"}
ROD: Any = {"constraint": "rod", "moving": True}
EXPLICIT = rs.Structure(2, 1, 2, **SPRINGS, scheme="fully explicit", num_micro=5)
LINEAR = rs.Structure(2, 1, 2, "matrix", "harmonic", "harmonic", scheme="explicit slow", num_micro=3)
COMPOSED = rs.Structure(2, 1, 1, **SPRINGS, **ROD, scheme="fully explicit", num_micro=2, composition="yoshida4")
STRUCTURES = {
    "explicit": (Method.EXPLICIT, EXPLICIT),
    "corrected kicks": (Method.EXPLICIT, rs.Structure(2, 1, 1, **SPRINGS, scheme="takahashi imada", num_micro=2)),
    "linear": (Method.LINEAR, LINEAR),
    "slow and fast apart": (
        Method.MASSES,
        rs.Structure(2, 1, 2, **SPRINGS, **HELD, scheme="explicit slow", num_micro=3),
    ),
    "composition": (Method.MASSES, COMPOSED),
}


@pytest.mark.parametrize("name", STRUCTURES)
def test_steppers_solve_the_equations_of_the_textbook(name):
    method, structure = STRUCTURES[name]
    assert_agrees(name, structure, method)


def test_the_residual_sees_a_millionth():
    structure = STRUCTURES["explicit"][1]
    draw = rs.tame_draw(Random("explicit 0"), structure)
    system, scheme = rs.problem(structure, draw).system, rs.scheme(structure, draw)
    start, save = rs.problem(structure, draw).state(), vm.Save(micro=True)
    run = vm.simulate(system, scheme, start, macro_dt=draw.macro_dt, num_steps=STEPS, save=save, solver=named("auto"))
    assert residual(system, scheme, run, draw.macro_dt) < BOUND
    moved = np.array(run.p_f)
    moved[2] *= 1 + 1e-6
    assert residual(system, scheme, run.with_arrays(p_f=moved), draw.macro_dt) > 1e-8


def test_textbook_leaves_mollified_kicks_out():
    structure = rs.Structure(scheme="mollified impulse", num_micro=2)
    draw = rs.tame_draw(Random(0), structure)
    problem = rs.problem(structure, draw)
    with pytest.raises(ValueError, match="mollified"):
        textbook.step(problem.system, rs.scheme(structure, draw), problem.state(), 0.1)

"""Steppers against the textbook, on random systems: shared by the tests of this folder.

Steps of degree 1 are put into the textbook's equations; others, whose inner control points no run saves, and
compositions end where the textbook's own solution ends.
"""

from functools import partial
from random import Random
from typing import Any

import jax
import numpy as np

import vmri_jax as vm
from benchmarks.gail2014.dense import named
from tests.textbook.residual import residual
from tests.verification import random_systems as rs
from vmri_jax import textbook

SPRINGS: dict[str, Any] = {"slow_potential": "harmonic", "fast_potential": "spring"}
DRAWS = 4
"""Systems of each structure; they share its compiled programs."""
STEPS = 4
"""Macro steps of a run."""
BOUND = 5e-12
"""Relative; the largest differences measured are 5e-13 (momenta) and 2e-14 (positions)."""

simulate_textbook = jax.jit(partial(textbook.simulate, num_steps=STEPS))


def agrees(structure: rs.Structure, draw: rs.Draw) -> str:
    """The name of the method that solved the steps, if they are the textbook's."""
    problem, scheme = rs.problem(structure, draw), rs.scheme(structure, draw)
    state, solver, system = problem.state(), named(structure.method), problem.system
    by_residual = structure.degree == 1 and structure.composition is None
    save = vm.Save(micro=by_residual)
    run = vm.simulate(system, scheme, state, macro_dt=draw.macro_dt, num_steps=STEPS, save=save, solver=solver)
    if by_residual:
        assert residual(system, scheme, run, draw.macro_dt) < BOUND
    else:
        expected = simulate_textbook(system, scheme, state, draw.macro_dt)
        for names in (("q_s", "q_f"), ("p_s", "p_f")):
            ours, theirs = (np.concatenate([getattr(a, name) for name in names], axis=1) for a in (run, expected))
            assert np.max(np.abs(ours - theirs)) < BOUND * np.max(np.abs(theirs))
    return vm.Method(int(np.max(run.info.method))).name


def assert_agrees(name: str, structure: rs.Structure, method: vm.Method) -> None:
    """Several systems of a structure end where the textbook's end, by the stepper that the structure is for."""
    draws = (rs.tame_draw(Random(f"{name} {i}"), structure) for i in range(DRAWS))
    assert {agrees(structure, draw) for draw in draws} == {method.name}

"""What a scene does not call for costs nothing: every effect in turn put into a scene and taken out again."""

import re
from collections import Counter

import jax
import numpy as np
import pytest

from tests.scene.effect_scenes import BASE, EFFECTS, RIGID, RIGID_EFFECTS, base_by_hand, scene_with
from tests.scene.mechanics import values
from vmri_jax import fully_explicit, plan
from vmri_jax import scene as sc
from vmri_jax.mechanics import invariants


def test_every_effect_is_in_the_list():
    listed = {type(effect) for effect in (*EFFECTS, *RIGID_EFFECTS, *BASE.effects)}
    offered = {value for value in vars(sc).values() if isinstance(value, type) and issubclass(value, sc.Effect)}
    assert offered - listed == {sc.Effect, sc.Joint, sc.CustomEffect}


CASES = [(BASE, effect) for effect in EFFECTS] + [(RIGID, effect) for effect in RIGID_EFFECTS]


@pytest.mark.parametrize(("base", "effect"), CASES, ids=lambda part: part.name if isinstance(part, sc.Effect) else "")
def test_what_is_taken_out_was_never_there(base, effect):
    """Equal static structure and equal shapes: the compiled program is the same one, by the rule that `jax.jit`
    follows."""
    scene = scene_with(effect, base)
    with_it, without, never = scene.system(), scene.without(effect.name).system(), base.system()
    assert jax.tree.structure(without) == jax.tree.structure(never)
    assert jax.tree.all(jax.tree.map(np.array_equal, without, never))
    assert jax.tree.structure(with_it) != jax.tree.structure(never)
    rows = {row.name: row for row in scene.explain(fully_explicit(5), measure=False).rows}
    start = scene.start[:2]
    micro, macro = (a - b for a, b in zip(with_it.num_constraints(*start), never.num_constraints(*start), strict=True))
    assert rows[effect.name].multipliers == 5 * micro + macro
    jax.eval_shape(values, with_it, 0.0, *scene.start)  # every function can be evaluated
    forces = jax.eval_shape(with_it.forces, 0.0, *scene.start)
    assert [f.shape for f in forces] == [q.shape for q in start]


def step(system, state, memory):
    """A macro step of `fully_explicit(5)`."""
    return plan(system, fully_explicit(5), state).step(state, memory, 0.01)


def look(system, state, memory):
    """All that a run computes at a saved node."""
    phase = state.q_s, state.q_f, state.p_s, state.p_f
    return invariants.energy(system, *phase), invariants.constraint_residual(system, state)


NO_OPERATION = {"parameter", "constant", "tuple", "get-tuple-element", "bitcast"}
"""Names of instructions in a compiled program that compute nothing."""
INSTRUCTION = re.compile(r"^\s*(?:ROOT )?%?[\w.-]+ = (?:\(.*?\)|\S+) ([a-z][a-z0-9-]*)\(", re.MULTILINE)
"""A line of XLA's text of a program, with the name of the instruction as its group."""


def operations(compiled) -> Counter:
    """Number of instructions of each name in a compiled program, with the instructions inside its fusions and loops."""
    return Counter(name for name in INSTRUCTION.findall(compiled.as_text()) if name not in NO_OPERATION)


@pytest.mark.parametrize("function", [step, look])
def test_program_is_that_of_the_system_written_by_hand(function):
    state, programs = BASE.state(), []
    for system in (BASE.system(), base_by_hand()):
        memory = jax.eval_shape(plan(system, fully_explicit(5), state).init, state, 0.01)
        programs.append(jax.jit(function).lower(system, state, memory).compile())
    ours, theirs = programs
    assert sum(operations(ours).values()) > 20
    assert operations(ours) == operations(theirs)
    assert ours.memory_analysis().temp_size_in_bytes == theirs.memory_analysis().temp_size_in_bytes

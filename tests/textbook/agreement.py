"""What the tests of this folder share: a stepper against the textbook, on random systems of one structure."""

from random import Random
from typing import Any

import vmri_jax as vm
from benchmarks import oracle
from tests.verification import random_systems as rs

SPRINGS: dict[str, Any] = {"slow_potential": "harmonic", "fast_potential": "spring"}
DRAWS = 4
"""Systems of each structure; they share its compiled programs."""
BOUND = 5e-12
"""Relative; the largest differences measured are 5e-13 (momenta) and 2e-14 (positions)."""


def agrees(structure: rs.Structure, draw: rs.Draw) -> str:
    """The method that solved the steps, if they end where the textbook's end."""
    comparison = oracle.compare(structure, draw)
    assert vm.Result[comparison.result].success
    assert max(comparison.positions, comparison.momenta) < BOUND
    return comparison.method


def assert_agrees(name: str, structure: rs.Structure, method: vm.Method) -> None:
    """Several systems of a structure end where the textbook's end, by the stepper that the structure is for."""
    draws = (rs.tame_draw(Random(f"{name} {i}"), structure) for i in range(DRAWS))
    assert {agrees(structure, draw) for draw in draws} == {method.name}

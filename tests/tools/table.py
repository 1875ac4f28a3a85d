"""The table of tools and small systems: what a cell has to work with, and how a file of tests runs its part of the
table.

A file of tests has TOOLS, functions of a `Cell` by name; each of them is run on every system of `tests.small_systems`.
A tool that cannot apply to a system refuses: REFUSED has a part of its sentence by (tool, system). All cells share a
scheme, a step and a number of nodes, so that they share compiled programs.
"""

import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import pytest

import vmri_jax as vm
from tests.small_systems import SYSTEMS
from vmri_jax.accuracy.families import of_order_2
from vmri_jax.mechanics.state import problem_of
from vmri_jax.study import ReferenceSolution, reference_solution

SCHEME = vm.fully_explicit(1)
MACRO_DT, STEPS = 0.01, 24
"""Of all runs; omega H is 0.2, and the shadow energy takes 23 nodes."""
T_END, REFERENCE_STEPS = 0.08, 520
"""Of all studies; the reference is good to 1e-6. Searches save ten nodes, of which the steps are a multiple."""
ERROR = 1e-3
"""What searches ask for."""
MENU = [replace(of_order_2(vm.fully_explicit), first=1)]

Tools = Mapping[str, Callable[["Cell"], object]]
Refused = Mapping[tuple[str, str], str]


@dataclass(frozen=True)
class Cell:
    """A system that a tool is tried on, and an empty folder."""

    system: str
    folder: Path
    patch: pytest.MonkeyPatch

    @property
    def moving(self):
        """The problem or the scene."""
        return SYSTEMS[self.system]

    @property
    def problem(self) -> vm.Problem:
        """The problem, a scene's too."""
        return problem_of("the table", self.moving)

    @property
    def run(self) -> vm.Trajectory:
        """A run; all cells of a file share it."""
        return run_of(self.system)

    @property
    def reference(self) -> ReferenceSolution:
        """The reference solution of studies; all cells of a file share it."""
        return reference_of(self.system)

    def quick_searches(self) -> None:
        """Let searches know one family, without micro steps."""
        self.patch.setattr("vmri_jax.study.tuning.families", lambda: MENU)
        self.patch.setattr("vmri_jax.accuracy.search.Search.has_two_rates", False)


@cache
def run_of(system: str) -> vm.Trajectory:
    """A run of a system."""
    return vm.simulate(SYSTEMS[system], SCHEME, macro_dt=MACRO_DT, num_steps=STEPS)


@cache
def reference_of(system: str) -> ReferenceSolution:
    """A reference solution of order 2."""
    return reference_solution(SYSTEMS[system], T_END, num_saves=1, num_steps=REFERENCE_STEPS, degree=1)


QUICK = ("one_coordinate", "fast_alone")
"""Systems whose cells run always; with all systems the table takes some ten minutes, and runs with --full."""


def cells(tools: Tools, full: Collection[tuple[str, str]] = ()):
    """A decorator: a test for each tool and each system; those of `full`, and systems that are not quick, run with
    --full only."""
    pairs = [(tool, system) for system in SYSTEMS for tool in tools]
    marked = [
        pytest.param(*pair, marks=() if pair[1] in QUICK and pair not in full else pytest.mark.full) for pair in pairs
    ]
    return pytest.mark.parametrize(("tool", "system"), marked)


def check(tools: Tools, refused: Refused, tool: str, cell: Cell) -> None:
    """Run the tool, which works, or refuses in its sentence."""
    sentence = refused.get((tool, cell.system))
    if sentence is None:
        tools[tool](cell)
        return
    with pytest.raises((ValueError, TypeError), match=re.escape(sentence)):
        tools[tool](cell)

"""Every stepper against the textbook: random tame systems, the largest difference per stepper."""

from collections.abc import Iterator
from functools import partial
from random import Random
from typing import NamedTuple

import jax
import numpy as np

import vmri_jax as vm
from benchmarks.measure import Tell, silent
from benchmarks.report import Report
from tests.verification import random_systems as rs
from vmri_jax import textbook

COLUMNS = ("method", "kind of step", "systems", "positions", "momenta", "worst")
DRAWS = 5
"""Systems of a structure, which share its compiled programs."""
FORGET = 10
"""Compiled programs are dropped after so many structures: a process has only so many memory maps for them."""
STEPS, EVERY = 4, 2

simulate_textbook = jax.jit(partial(textbook.simulate, num_steps=STEPS))


class Size(NamedTuple):
    """Systems, and the seed that they are drawn from."""

    count: int
    seed: int


def sizes(name: str, count: int, seed: int) -> Size:
    """So many systems, whatever the name."""
    return Size(count, seed)


class Comparison(NamedTuple):
    """One system: how it was solved, how the run ended, largest differences over largest values."""

    method: str
    kind: str
    result: str
    positions: float
    momenta: float


def compare(of: rs.Structure, draw: rs.Draw) -> Comparison:
    """A few macro steps by the stepper of a structure, and by the textbook."""
    problem, scheme = rs.problem(of, draw), rs.scheme(of, draw)
    state = problem.state()
    solver = vm.solvers.named(of.method)()  # pyright: ignore
    how = {"macro_dt": draw.macro_dt, "num_steps": STEPS, "save_every": EVERY, "solver": solver, "throw": False}
    run = vm.simulate(problem.system, scheme, state, **how)
    expected = simulate_textbook(problem.system, scheme, state, draw.macro_dt)
    method = vm.Method(int(np.max(run.info.method))).name
    kind = kind_of_step(vm.plan(problem.system, scheme, state, solver))
    differences = [_relative(run, expected, names) for names in (("q_s", "q_f"), ("p_s", "p_f"))]
    return Comparison(method, kind, vm.Result(int(run.result)).name, *differences)


def _relative(run: vm.Trajectory, expected: vm.State, names: tuple[str, str]) -> float:
    """Largest difference over the largest size of what is expected; NaN counts as infinite."""
    a = np.concatenate([np.asarray(getattr(run, name)) for name in names], axis=1)
    b = np.concatenate([np.asarray(getattr(expected, name))[::EVERY] for name in names], axis=1)
    difference = np.max(np.abs(a - b)) / np.max(np.abs(b))
    return float(difference) if np.isfinite(difference) else np.inf


def kind_of_step(plan: vm.Plan) -> str:
    """The outermost stepper of a plan in words, kicks aside."""
    lines = [line.strip() for line in str(plan).splitlines()]
    inside = next(line for line in lines if not line.startswith("kicks of"))
    return inside.partition(":")[0]


def systems(count: int, seed: int) -> Iterator[tuple[int, rs.Structure, rs.Draw]]:
    """Number, structure and draw of each system."""
    for number in range(count):
        of = rs.structure(Random(f"{seed} tame structure {number // DRAWS}"), tame=True)
        yield number, of, rs.tame_draw(Random(f"{seed} tame draw {number}"), of)


def run(size: Size, name: str, tell: Tell = silent) -> Iterator[Report]:
    """Compare all of them, a report after each structure."""
    found = []
    for number, of, draw in systems(size.count, size.seed):
        tell(f"system {number}")
        if number % (DRAWS * FORGET) == 0:
            rs.functions.cache_clear()
            jax.clear_caches()
        found.append({"system": number} | compare(of, draw)._asdict())
        if number % DRAWS == DRAWS - 1 or number == size.count - 1:
            notes = [f"{len(found)} systems against the textbook"]
            about = {"seed": size.seed, "systems": found}
            yield Report(f"oracle_{size.seed}", name, summary(found), [], notes, about=about)


def summary(found: list[dict]) -> list[dict]:
    """Per stepper the number of systems, the largest differences, and in which system the largest of them is."""
    rows = []
    for method, kind in sorted({(one["method"], one["kind"]) for one in found}):
        those = [one for one in found if (one["method"], one["kind"]) == (method, kind)]
        largest = {name: max(one[name] for one in those) for name in ("positions", "momenta")}
        worst = max(those, key=lambda one: max(one["positions"], one["momenta"]))["system"]
        rows.append({"method": method, "kind of step": kind, "systems": len(those)} | largest | {"worst": worst})
    return rows

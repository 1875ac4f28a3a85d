"""Every stepper against the textbook: random tame systems, the largest difference per stepper."""

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from random import Random
from typing import NamedTuple

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

import vmri_jax as vm
from benchmarks.measure import Tell, machine, silent
from tests.verification import random_systems as rs
from vmri_jax import textbook

DRAWS = 5
"""Systems of a structure, which share its compiled programs."""
FORGET = 10
"""Compiled programs are dropped after so many structures: a process has only so many memory maps for them."""
STEPS, EVERY = 4, 2

simulate_textbook = jax.jit(partial(textbook.simulate, num_steps=STEPS))


class Comparison(NamedTuple):
    """One system: how its step was solved, how the run ended, and the largest differences relative to the largest values."""

    method: str
    kind: str
    result: str
    positions: float
    momenta: float


def compare(of: rs.Structure, draw: rs.Draw) -> Comparison:
    """A few macro steps by the stepper of a structure, and by the textbook."""
    problem, scheme = rs.problem(of, draw), rs.scheme(of, draw)
    state = problem.state()
    newton = vm.Newton(of.method)  # pyright: ignore
    how = {"macro_dt": draw.macro_dt, "num_steps": STEPS, "save_every": EVERY, "newton": newton, "throw": False}
    run = vm.simulate(problem.system, scheme, state, **how)
    expected = simulate_textbook(problem.system, scheme, state, draw.macro_dt)
    method = vm.Method(int(np.max(run.info.method))).name
    differences = [_relative(run, expected, names) for names in (("q_s", "q_f"), ("p_s", "p_f"))]
    return Comparison(method, kind_of_step(of), vm.Result(int(run.result)).name, *differences)


def _relative(run: vm.Trajectory, expected: vm.State, names: tuple[str, str]) -> float:
    """Largest difference over the largest size of what is expected; NaN counts as infinite."""
    a = np.concatenate([np.asarray(getattr(run, name)) for name in names], axis=1)
    b = np.concatenate([np.asarray(getattr(expected, name))[::EVERY] for name in names], axis=1)
    difference = np.max(np.abs(a - b)) / np.max(np.abs(b))
    return float(difference) if np.isfinite(difference) else np.inf


def kind_of_step(of: rs.Structure) -> str:
    """What kind of step a structure asks for, in words."""
    held = of.constraint or of.slow_constraint
    kicked = of.scheme in ("explicit slow", "fully explicit", "takahashi imada")
    plain = of.kinetic in ("diagonal", "matrix") and not of.force
    if of.composition:
        return "composition"
    if plain and kicked and of.scheme != "explicit slow" and not held:
        return "explicit"
    if plain and kicked and of.constraint in (None, "anchored"):
        return "slow and fast apart"
    if plain and kicked and of.scheme != "explicit slow" and of.num_micro == 1:
        return "drift along constraints"
    if plain and of.num_micro == 1 and of.degree > 1 and of.scheme != "mixed":
        return "one interval of high degree"
    return "slow and fast together"


def systems(count: int, seed: int) -> Iterator[tuple[int, rs.Structure, rs.Draw]]:
    """Number, structure and draw of each system."""
    for number in range(count):
        of = rs.structure(Random(f"{seed} tame structure {number // DRAWS}"), tame=True)
        yield number, of, rs.tame_draw(Random(f"{seed} tame draw {number}"), of)


def run(count: int, seed: int, path: Path, tell: Tell = silent) -> list[dict]:
    """Compare so many systems; what is known by then is written after each structure."""
    path.parent.mkdir(parents=True, exist_ok=True)
    found = []
    for number, of, draw in systems(count, seed):
        tell(f"system {number}")
        if number % (DRAWS * FORGET) == 0:
            rs.functions.cache_clear()
            jax.clear_caches()
        found.append({"system": number} | compare(of, draw)._asdict())
        if number % DRAWS == DRAWS - 1 or number == count - 1:
            report = {"machine": machine(), "seed": seed, "steppers": summary(found), "systems": found}
            path.write_text(json.dumps(report, indent=1))
    return found


def summary(found: list[dict]) -> list[dict]:
    """Per stepper the number of systems, the largest differences, and in which system the largest of them is."""
    rows = []
    for method, kind in sorted({(one["method"], one["kind"]) for one in found}):
        those = [one for one in found if (one["method"], one["kind"]) == (method, kind)]
        largest = {name: max(one[name] for one in those) for name in ("positions", "momenta")}
        worst = max(those, key=lambda one: max(one["positions"], one["momenta"]))["system"]
        rows.append({"method": method, "kind of step": kind, "systems": len(those)} | largest | {"worst": worst})
    return rows


def show(found: list[dict], console: Console) -> None:
    """Print the summary."""
    table = Table(title=f"{len(found)} systems against the textbook", title_justify="left", box=None)
    rows = summary(found)
    for name in rows[0]:
        table.add_column(name)
    for row in rows:
        table.add_row(*(f"{value:.1e}" if isinstance(value, float) else str(value) for value in row.values()))
    console.print(table)

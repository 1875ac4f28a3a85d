"""The ledger of a scene: what every body and effect adds to a macro step, and what it costs."""

import re
from collections import Counter
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from rich.table import Table

from vmri_jax.diagnostics import frequencies
from vmri_jax.mechanics.state import initial_state
from vmri_jax.mechanics.system import System
from vmri_jax.running.simulate import Simulation, prepare
from vmri_jax.running.timing import interleaved
from vmri_jax.scene.assembly import build
from vmri_jax.scene.sorting import Sorting
from vmri_jax.schemes.composition import Composition, stage_scheme
from vmri_jax.schemes.scheme import Scheme

HOMES = {
    "kinetic": "kinetic energy T",
    "slow_potential": "slow potential V",
    "fast_potential": "fast potential W",
    "constraint": "constraint g",
    "slow_constraint": "constraint g_s",
    "force": "force F",
}
RULES = {"slow_potential": "slow", "fast_potential": "fast"}
"""What a scheme calls its rules of these parts."""
STEPS = 20
"""Macro steps of a program that is timed."""


@dataclass(frozen=True)
class Row:
    """One body or effect.

    name, kind: what it is called, and "body" or the term it is part of.
    grid, why: "macro" or "micro", where it lives, and how that was decided.
    unknowns, multipliers: it adds to the equations of a macro step.
    evaluations: nodes of a macro step at which its function is evaluated (by implicit schemes in every Newton iteration).
    operations, time: shares of the compiled operations and of the measured time that go with it, None where not measured.
    """

    name: str
    kind: str
    grid: str
    why: str
    unknowns: int
    multipliers: int
    evaluations: int
    operations: float | None = None
    time: float | None = None


@dataclass(frozen=True)
class Program:
    """A compiled scene: instructions of the optimised program, temporary bytes, microseconds per macro step."""

    operations: int
    temporary_bytes: int
    microseconds: float


@dataclass(frozen=True)
class Ledger:
    """Rows of bodies and effects; the whole scene and its bodies alone as programs (None where not measured)."""

    rows: tuple[Row, ...]
    scene: Program | None = None
    bare: Program | None = None

    @property
    def unknowns(self) -> int:
        """Unknowns of a macro step, multipliers included: ``r n_s + r n_gs + num_micro r (n_f + n_g)``."""
        return sum(row.unknowns + row.multipliers for row in self.rows)

    def as_dict(self) -> dict[str, Any]:
        """Plain data: "rows", "unknowns", "scene", "bare"."""
        return asdict(self) | {"rows": [asdict(row) for row in self.rows], "unknowns": self.unknowns}

    def table(self) -> Table:
        """A table for `rich.print`."""
        costs = ("operations", "time") if self.scene is not None else ()
        table = Table("name", "part of", "grid", "unknowns", "multipliers", "evaluations", box=None, pad_edge=False)
        for column in costs:
            table.add_column(column, justify="right")
        table.add_column("why", style="dim")
        for row in self.rows:
            numbers = [str(n) if n else "" for n in (row.unknowns, row.multipliers, row.evaluations)]
            shares = [getattr(row, cost) for cost in costs]
            percents = [f"{100 * share:.0f} %" if share is not None else "" for share in shares]
            table.add_row(f"[bold]{row.name}[/bold]", row.kind, row.grid, *numbers, *percents, row.why)
        for name, program in {"the scene": self.scene, "its bodies alone": self.bare}.items():
            if program is not None:
                cost = (str(program.operations), f"{program.microseconds:.3g} µs", f"{program.temporary_bytes} bytes")
                unknowns = str(self.unknowns) if program is self.scene else ""
                table.add_row(name, "", "", unknowns, "", "", *cost, style="italic")
        return table


def ledger(sorting: Sorting, scheme: Scheme | Composition, macro_dt: float | None, measure: bool) -> Ledger:
    """The ledger of a scene, see `Scene.explain`.

    Args:
        sorting: bodies at their places, effects at their homes.
        scheme, macro_dt, measure: as of `Scene.explain`.
    """
    if not isinstance(scheme, Scheme | Composition):
        raise TypeError(f"Scene.explain: scheme is {scheme!r}; give a Scheme, e.g. fully_implicit(num_micro=10).")
    stages = scheme.num_stages if isinstance(scheme, Composition) else 1
    one = stage_scheme(scheme)
    intervals = {"macro": stages * one.degree, "micro": stages * one.degree * one.num_micro}
    rows = []
    for name, pace in sorting.paces.items():
        grid = "micro" if pace.value == "fast" else "macro"
        unknowns = intervals[grid] * sorting.bodies[name].size
        rows.append(Row(name, "body", grid, f"{pace.value}: {pace.reason}", unknowns, 0, 0))
    whole, bare, shares = _measure(sorting, scheme, macro_dt) if measure else (None, None, {})
    for part in sorting.placed:
        name = part.effect.name
        rule = getattr(one, RULES.get(part.home, part.home))
        multipliers = intervals[rule.grid] * sum(build(sorting, [part]).num_constraints(*sorting.start[:2]))
        count = stages * evaluations(rule, one.num_micro)
        share = shares.get(name, (None, None))
        rows.append(Row(name, HOMES[part.home], rule.grid, part.reason, 0, multipliers, count, *share))
    return Ledger(tuple(rows), whole, bare)


def evaluations(rule, num_micro: int) -> int:
    """Nodes of a rule in a macro step, one at the border of two steps counted once."""
    nodes = rule.composite(num_micro).nodes
    shared = np.isclose(nodes[0], 0.0) and np.isclose(nodes[-1], 1.0)
    return len(nodes) - int(shared)


def _measure(sorting: Sorting, scheme, macro_dt) -> tuple[Program, Program, dict]:
    """The scene's program, that of its bodies alone, and shares of operations and time by effect."""
    names = dict.fromkeys(part.effect.name for part in sorting.placed)
    kept = {f"without {name}": [part for part in sorting.placed if part.effect.name != name] for name in names}
    systems = {key: build(sorting, some) for key, some in {"whole": sorting.placed, "bare": (), **kept}.items()}
    states = {key: initial_state(system, *sorting.start) for key, system in systems.items()}
    if macro_dt is None:
        fastest = float(frequencies(systems["whole"], states["whole"])[0])
        macro_dt = scheme.num_micro * 0.1 / fastest if fastest > 0 else 0.01
    runs = {key: prepare_steps(system, scheme, states[key], macro_dt) for key, system in systems.items()}
    times = interleaved({key: run.timed() for key, run in runs.items()}, 5)
    programs = {}
    for key, run in runs.items():
        compiled, us = run.compiled(), 1e6 * float(np.median(times[key])) / STEPS
        programs[key] = Program(sum(operations(compiled).values()), temporary_bytes(compiled), us)
    whole, shares = programs["whole"], {}
    for name in names:
        left = programs[f"without {name}"]
        shares[name] = 1 - left.operations / whole.operations, 1 - left.microseconds / whole.microseconds
    return whole, programs["bare"], shares


def prepare_steps(system: System, scheme: Scheme | Composition, state, macro_dt, num_steps: int = STEPS) -> Simulation:
    """So many macro steps, prepared; `operations` and `temporary_bytes` look into ``.compiled()``.

    Args:
        system, scheme, state, macro_dt, num_steps: as of `vmri_jax.prepare`.
    """
    return prepare(system, scheme, state, macro_dt=macro_dt, num_steps=num_steps, save_every=num_steps)


NO_OPERATION = {"parameter", "constant", "tuple", "get-tuple-element", "bitcast"}
INSTRUCTION = re.compile(r"^\s*(?:ROOT )?%?[\w.-]+ = (?:\(.*?\)|\S+) ([a-z][a-z0-9-]*)\(", re.MULTILINE)


def operations(compiled) -> Counter:
    """Instructions of a compiled program by name, those inside its fusions and loops included."""
    return Counter(name for name in INSTRUCTION.findall(compiled.as_text()) if name not in NO_OPERATION)


def temporary_bytes(compiled) -> int:
    """Temporary memory of a compiled program."""
    return compiled.memory_analysis().temp_size_in_bytes

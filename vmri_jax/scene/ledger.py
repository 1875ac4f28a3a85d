"""The ledger of a scene: what every body and effect adds to a macro step, and what it costs."""

import re
from collections import Counter
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vmri_jax.diagnostics import frequencies
from vmri_jax.mechanics.state import initial_state
from vmri_jax.mechanics.system import System
from vmri_jax.running.simulate import Simulation, prepare
from vmri_jax.scene.assembly import build
from vmri_jax.schemes.composition import Composition, stage_scheme
from vmri_jax.schemes.scheme import Scheme

if TYPE_CHECKING:
    from rich.table import Table

    from vmri_jax.scene.scene import Scene

HOMES = {
    "kinetic": "kinetic energy T",
    "slow_potential": "slow potential V",
    "fast_potential": "fast potential W",
    "constraint": "constraint g",
    "slow_constraint": "constraint g_s",
    "force": "force F",
}
STEPS = 20
"""Macro steps of a program that is timed."""


@dataclass(frozen=True)
class Row:
    """One body or effect.

    name, kind: what it is called, and "body" or the term it is part of.
    grid: "macro" or "micro", where it lives. why: how that was decided.
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

    def table(self) -> "Table":
        """A table for `rich.print`."""
        from rich.table import Table

        measured = self.scene is not None
        table = Table("name", "part of", "grid", "unknowns", "multipliers", "evaluations", box=None, pad_edge=False)
        for column in ("operations", "time") if measured else ():
            table.add_column(column, justify="right")
        table.add_column("why", style="dim")
        for row in self.rows:
            shares = [f"{100 * share:.0f} %" if share is not None else "" for share in (row.operations, row.time)]
            numbers = [str(n) if n else "" for n in (row.unknowns, row.multipliers, row.evaluations)]
            table.add_row(
                f"[bold]{row.name}[/bold]", row.kind, row.grid, *numbers, *(shares if measured else []), row.why
            )
        totals = {"the scene": self.scene, "its bodies alone": self.bare}
        for name, program in totals.items():
            if program is not None:
                cost = (str(program.operations), f"{program.microseconds:.3g} µs")
                unknowns = str(self.unknowns) if name == "the scene" else ""
                table.add_row(name, "", "", unknowns, "", "", *cost, f"{program.temporary_bytes} bytes", style="italic")
        return table


def ledger(scene: "Scene", scheme: Scheme | Composition, macro_dt: float | None, measure: bool) -> Ledger:
    """The ledger of a scene, see `Scene.explain`."""
    if not isinstance(scheme, Scheme | Composition):
        raise TypeError(f"Scene.explain: scheme is {scheme!r}; give a Scheme, e.g. fully_implicit(num_micro=10).")
    stages = scheme.num_stages if isinstance(scheme, Composition) else 1
    one = stage_scheme(scheme)
    intervals = {"macro": stages * one.degree, "micro": stages * one.degree * one.num_micro}
    rows = []
    for name, pace in scene.sorting.paces.items():
        grid = "micro" if pace.value == "fast" else "macro"
        rows.append(
            Row(name, "body", grid, f"{pace.value}: {pace.reason}", intervals[grid] * scene.by_name[name].size, 0, 0)
        )
    whole, bare, shares = _measure(scene, scheme, macro_dt) if measure else (None, None, {})
    for part in scene.sorting.placed:
        placed = (
            one.slow
            if part.home == "slow_potential"
            else one.fast
            if part.home == "fast_potential"
            else getattr(one, part.home)
        )
        alone = build(scene.by_name, scene.places, [part])
        values = sum(alone.num_constraints(*scene.start[:2]))
        count = stages * evaluations(placed, one.num_micro)
        rows.append(
            Row(
                part.effect.name,
                HOMES[part.home],
                placed.grid,
                part.reason,
                0,
                intervals[placed.grid] * values,
                count,
                *shares.get(part.effect.name, (None, None)),
            )
        )
    return Ledger(tuple(rows), whole, bare)


def evaluations(placed, num_micro: int) -> int:
    """Nodes of a rule in a macro step, one at the border of two steps counted once."""
    nodes = placed.composite(num_micro).nodes
    shared = np.isclose(nodes[0], 0.0) and np.isclose(nodes[-1], 1.0)
    return len(nodes) - int(shared)


def _measure(scene, scheme, macro_dt) -> tuple[Program, Program, dict]:
    """The scene's program, that of its bodies alone, and shares of operations and time by effect."""
    from vmri_jax.study.timing import interleaved

    placed, whole, bare = scene.sorting.placed, "whole", "bare"
    names = {effect.name: f"without {effect.name}" for effect in scene.effects}
    kept = {key: [part for part in placed if part.effect.name != name] for name, key in names.items()}
    kept |= {whole: list(placed), bare: []}
    systems = {key: build(scene.by_name, scene.places, parts) for key, parts in kept.items()}
    states = {key: initial_state(system, *scene.start) for key, system in systems.items()}
    if macro_dt is None:
        fastest = float(frequencies(systems[whole], states[whole])[0])
        macro_dt = scheme.num_micro * 0.1 / fastest if fastest > 0 else 0.01
    arguments = {key: (system, scheme, states[key], macro_dt) for key, system in systems.items()}
    runs = {key: prepare_steps(*some) for key, some in arguments.items()}
    times = interleaved({key: run.timed() for key, run in runs.items()}, 5)

    def program(key: str) -> Program:
        us = 1e6 * float(np.median(times[key])) / STEPS
        compiled = runs[key].compiled()
        return Program(sum(operations(compiled).values()), temporary_bytes(compiled), us)

    of = {key: program(key) for key in systems}
    shares = {
        name: (1 - of[key].operations / of[whole].operations, 1 - of[key].microseconds / of[whole].microseconds)
        for name, key in names.items()
    }
    return of[whole], of[bare], shares


def prepare_steps(system: System, scheme: Scheme | Composition, state, macro_dt, num_steps: int = STEPS) -> Simulation:
    """So many macro steps, prepared; `operations` and `temporary_bytes` look into ``.compiled()``."""
    return prepare(system, scheme, state, macro_dt=macro_dt, num_steps=num_steps, save_every=num_steps)


NO_OPERATION = {"parameter", "constant", "tuple", "get-tuple-element", "bitcast"}
INSTRUCTION = re.compile(r"^\s*(?:ROOT )?%?[\w.-]+ = (?:\(.*?\)|\S+) ([a-z][a-z0-9-]*)\(", re.MULTILINE)


def operations(compiled) -> Counter:
    """Instructions of a compiled program by name, those inside its fusions and loops included."""
    return Counter(name for name in INSTRUCTION.findall(compiled.as_text()) if name not in NO_OPERATION)


def temporary_bytes(compiled) -> int:
    """Temporary memory of a compiled program."""
    return compiled.memory_analysis().temp_size_in_bytes

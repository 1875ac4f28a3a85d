"""The ledger of a scene or of a system of functions: grid, unknowns, evaluations and computing time of every body and effect."""

import re
from collections import Counter
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics import invariants
from vmri_jax.mechanics.linearisation import linearise
from vmri_jax.mechanics.masses import ConstantMass
from vmri_jax.mechanics.names import Names
from vmri_jax.mechanics.state import Problem, State, initial_state
from vmri_jax.mechanics.surroundings import name_of
from vmri_jax.mechanics.system import System
from vmri_jax.mechanics.terms import KINDS, Term
from vmri_jax.refusals import Refused
from vmri_jax.running.prepare import prepare
from vmri_jax.running.printed import PrintedTable
from vmri_jax.running.simulation import Simulation
from vmri_jax.running.timing import interleaved, seconds_each
from vmri_jax.scene.assembly import build
from vmri_jax.scene.sorting import Sorting
from vmri_jax.schemes.composition import Composition, stage_scheme
from vmri_jax.schemes.scheme import Scheme

OTHER_TERMS: dict[Any, tuple[str, str]] = {
    "control": ("F", "control u"),
    "fast": ("fast", "potential on the micro grid"),
}
"""For each term of an effect that is no argument of `System`, the key of its rule in `Scheme.rule_of`, and its name in the ledger."""
STEPS = 20
"""Macro steps of the program that is timed: enough that the call of the program takes little of the time. More take longer."""
DEFAULT_FREQUENCY = 10.0
"""rad/s, from which the step size of a timed step follows if the system neither vibrates nor turns. A larger one takes smaller steps."""


@dataclass(frozen=True)
class LedgerRow:
    """A body or effect in the ledger.

    kind: "body", or the term that the effect is part of.
    grid, why: "macro" or "micro", the grid of its unknowns or evaluations, and the reason for it.
    unknowns, multipliers: how many of each it adds to the equations of a macro step.
    evaluations: number of nodes in a macro step at which its function is evaluated (by implicit schemes in every Newton iteration).
    microseconds: computing time of its first derivatives once at all these nodes, None if not measured.
    """

    name: str
    kind: str
    grid: str
    why: str
    unknowns: int
    multipliers: int
    evaluations: int
    microseconds: float | None = None


@dataclass(frozen=True)
class Ledger:
    """Rows of bodies and effects, and the computing time of a macro step of the whole scene in microseconds (None if not measured)."""

    rows: tuple[LedgerRow, ...]
    microseconds: float | None = None

    @property
    def unknowns(self) -> int:
        """Unknowns and multipliers of all stages of a macro step: ``r (n_s + n_gs + num_micro (n_f + n_g))`` for each, with degree r and rows n_gs of g_s, n_g of g."""
        return sum(row.unknowns + row.multipliers for row in self.rows)

    def table(self) -> PrintedTable:
        """Unknowns, evaluations and time of every body and effect; the reasons for their grids are in `reasons`."""
        table = PrintedTable("name", "part of", "grid")
        for column in ("unknowns", "evaluations", *(["time"] if self.microseconds is not None else [])):
            table.add_column(column, justify="right")
        for row in self.rows:
            numbers = [str(n) if n else "" for n in (row.unknowns + row.multipliers, row.evaluations)]
            time = [] if row.microseconds is None else [f"{row.microseconds:.2g} µs"]
            table.add_row(f"[bold]{row.name}[/bold]", row.kind, row.grid, *numbers, *time)
        step = [] if self.microseconds is None else [f"{self.microseconds:.3g} µs"]
        table.add_row("a macro step", "", "", str(self.unknowns), "", *step, style="italic")
        return table

    def __repr__(self) -> str:
        return str(self.table())

    def _repr_mimebundle_(self, include=(), exclude=(), **kwargs) -> dict[str, str]:
        """The table, for notebooks."""
        return self.table()._repr_mimebundle_(include, exclude, **kwargs)

    def reasons(self) -> PrintedTable:
        """For every body the reason why it is slow or fast, for every effect the reason for its grid."""
        table = PrintedTable("name", "why")
        for row in self.rows:
            table.add_row(f"[bold]{row.name}[/bold]", row.why)
        return table


def ledger(sorting: Sorting, scheme: Scheme | Composition, macro_dt: float | None, measure: bool) -> Ledger:
    """The ledger of a scene, see `Scene.explain`."""
    if not isinstance(scheme, Scheme | Composition):
        raise Refused(f"Scene.explain: scheme is {scheme!r}; give a Scheme, e.g. fully_implicit(num_micro=10).")
    stage, stages, intervals = _intervals(scheme)
    rows = []
    sizes = {name: place.size for name, place in sorting.layout.bodies.items()}
    sizes |= {branch.child: len(branch.joint.freedoms) for branch in sorting.branches}
    for name, pace in sorting.paces.items():
        grid = "micro" if pace.value == "fast" else "macro"
        unknowns = intervals[grid] * sizes[name]
        rows.append(LedgerRow(name, "body", grid, f"{pace.value}: {pace.reason}", unknowns, 0, 0))
    step_time, times = _measure(sorting, scheme, macro_dt) if measure else (None, [None] * len(sorting.placed))
    for part, nanoseconds in zip(sorting.placed, times, strict=True):
        symbol, kind = _term(part.home)
        rule = stage.rule_of(symbol)
        multipliers = intervals[rule.grid] * sum(build(sorting, [part]).num_constraints(*sorting.start[:2]))
        count = 0 if part.home == "control" else stages * rule.evaluations(stage.num_micro)
        microseconds = None if nanoseconds is None else nanoseconds * count / 1e3
        rows.append(LedgerRow(part.effect.name, kind, rule.grid, part.reason, 0, multipliers, count, microseconds))
    return Ledger(tuple(rows), step_time)


def _intervals(scheme: Scheme | Composition) -> tuple[Scheme, int, dict[str, int]]:
    """The scheme of a stage, the number of stages, and the number of unknown nodes in a macro step on each grid."""
    stage = stage_scheme(scheme)
    stages = scheme.num_stages if isinstance(scheme, Composition) else 1
    return stage, stages, {"macro": stages * stage.degree, "micro": stages * stage.degree * stage.num_micro}


def _term(home: Any) -> tuple[Any, str]:
    """The key of the rule in `Scheme.rule_of`, and the name, of the term of a scene that an effect is part of."""
    if home in KINDS:
        kind = KINDS[home]
        return kind.symbol, f"{kind.in_words} {kind.symbol}"
    return OTHER_TERMS.get(home, (home, f"potential on one in {home} micro nodes"))


def ledger_of_functions(
    problem: Problem, scheme: Scheme | Composition, macro_dt: float | None = None, measure: bool = True
) -> Ledger:
    """The ledger of a system of functions: its coordinates by name, and each of its functions; see `Scene.explain`."""
    system, state = problem.system, problem.state()
    stage, stages, intervals = _intervals(scheme)
    names = (problem.names or Names()).of_coordinates(state.q_s.size, state.q_f.size)
    rows = []
    for name, (part, _, size) in names.bodies.items():
        pace, grid = ("fast", "micro") if part == "f" else ("slow", "macro")
        rows.append(LedgerRow(name, "body", grid, f"{pace}: it is in q_{part}", intervals[grid] * size, 0, 0))

    for term in system.terms:
        # T_s is a part of the row of T; masses cost nothing, and steps do not solve for implied rows
        if term.kind == "implied" or term.name == "T_s" or isinstance(term.function, ConstantMass):
            continue
        rule, alone = stage.rule_of(term.name), _alone(system, term, state)
        multipliers = intervals[rule.grid] * sum(alone.num_constraints(state.q_s, state.q_f))
        count, microseconds = stages * rule.evaluations(stage.num_micro), None
        if measure:
            derivatives = _first_derivatives(alone, state.q_s.size, problem.v_s, problem.v_f)
            microseconds = 1e6 * seconds_each(derivatives, jnp.concatenate([state.q_s, state.q_f])) * count
        kind = f"{KINDS[term.field].in_words} {term.label}"
        why = f"the rule of the scheme for it: {rule.in_words()}"
        rows.append(LedgerRow(name_of(term.function), kind, rule.grid, why, 0, multipliers, count, microseconds))
    return Ledger(tuple(rows), _macro_step(system, scheme, state, macro_dt, DEFAULT_FREQUENCY) if measure else None)


def _alone(system: System, term: Term, state: State) -> System:
    """The system with one term alone, and with unit masses unless this is the kinetic energy."""
    masses = ConstantMass(np.ones(state.q_s.size), np.ones(state.q_f.size))

    def function(other: Term):
        if other.name == term.name or other.kind == term.kind == "kinetic":
            return other.function
        return masses if other.name == "T" else None

    return system.mapped(function)


def _measure(sorting: Sorting, scheme, macro_dt) -> tuple[float, list[float]]:
    """Microseconds of a macro step, and nanoseconds of an evaluation of the first derivatives of every effect."""
    system = build(sorting, sorting.placed)
    state = initial_state(system, *sorting.start, project=True)
    q_s, q_f, v_s, v_f = sorting.start
    largest_q, largest_v = (max(np.abs(x).max(initial=0.0) for x in pair) for pair in ((q_s, q_f), (v_s, v_f)))
    turning = float(largest_v / max(largest_q, 1e-300))  # rad/s; of a spinning body roughly its angular velocity
    step = _macro_step(system, scheme, state, macro_dt, turning or DEFAULT_FREQUENCY)
    of_effects = [_first_derivatives(build(sorting, [part]), q_s.size, v_s, v_f) for part in sorting.placed]
    q = jnp.concatenate([q_s, q_f])
    return step, [1e9 * seconds_each(derivatives, q) for derivatives in of_effects]


def _macro_step(system: System, scheme, state: State, macro_dt: float | None, frequency: float) -> float:
    """Microseconds of a macro step, by default of micro steps 0.1 / w, w the largest frequency or `frequency`."""
    if macro_dt is None:
        macro_dt = scheme.num_micro * 0.1 / (float(linearise(system, state).frequencies.max(initial=0.0)) or frequency)
    seconds = interleaved({"": prepare_steps(system, scheme, state, macro_dt).timed()}, 5)[""]
    return 1e6 * float(np.median(seconds)) / STEPS


def _first_derivatives(system: System, n_s: int, v_s, v_f):
    """All first derivatives of a system that a step takes, added up, as a function of its positions q (n,) that returns (n,)."""

    def lagrangian(q):
        potentials = invariants.potential_energy(system, q[:n_s], q[n_s:])
        if system.has_constant_mass:
            return -potentials
        return system.kinetic_energy(q[:n_s], q[n_s:], v_s, v_f) - potentials

    def derivatives(q):
        total = jax.grad(lagrangian)(q)
        if system.is_constrained:
            total += jax.jacrev(lambda q: system.constraints(0.0, q[:n_s], q[n_s:]))(q).sum(axis=0)
        if system.force is not None:
            total += jnp.concatenate(system.forces(0.0, q[:n_s], q[n_s:], v_s, v_f))
        return total

    return derivatives


def prepare_steps(system: System, scheme: Scheme | Composition, state, macro_dt, num_steps: int = STEPS) -> Simulation:
    """A simulation, see `vmri_jax.prepare`, that saves the end alone; `operations` and `temporary_bytes` take its ``.compiled()``."""
    return prepare(system, scheme, state, macro_dt=macro_dt, num_steps=num_steps, save=num_steps)


NO_OPERATION = {"parameter", "constant", "tuple", "get-tuple-element", "bitcast"}
"""Names of instructions in a compiled program that compute nothing."""
INSTRUCTION = re.compile(r"^\s*(?:ROOT )?%?[\w.-]+ = (?:\(.*?\)|\S+) ([a-z][a-z0-9-]*)\(", re.MULTILINE)
"""A line of XLA's text of a program, with the name of the instruction as its group."""


def operations(compiled) -> Counter:
    """Number of instructions of each name in a compiled program, with the instructions inside its fusions and loops."""
    return Counter(name for name in INSTRUCTION.findall(compiled.as_text()) if name not in NO_OPERATION)


def temporary_bytes(compiled) -> int:
    """Temporary memory of a compiled program, bytes."""
    return compiled.memory_analysis().temp_size_in_bytes

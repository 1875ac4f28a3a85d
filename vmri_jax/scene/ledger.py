"""The ledger of a scene or of a system of functions: what every body and effect adds to a macro step, and what it costs."""

import re
from collections import Counter
from dataclasses import asdict, dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.diagnostics import frequencies
from vmri_jax.mechanics import invariants
from vmri_jax.mechanics.masses import ConstantMass
from vmri_jax.mechanics.names import Names
from vmri_jax.mechanics.state import Problem, State, initial_state
from vmri_jax.mechanics.summary import name_of
from vmri_jax.mechanics.system import System, label
from vmri_jax.running.printed import PrintedTable
from vmri_jax.running.simulation import Simulation, prepare
from vmri_jax.running.timing import interleaved, seconds_each
from vmri_jax.scene.assembly import build
from vmri_jax.scene.sorting import Sorting
from vmri_jax.schemes.composition import Composition, stage_scheme
from vmri_jax.schemes.quadrature import PlacedRule
from vmri_jax.schemes.scheme import Scheme

HOMES: dict[Any, str] = {
    "kinetic": "kinetic energy T",
    "slow_potential": "slow potential V",
    "fast_potential": "fast potential W",
    "constraint": "constraint g",
    "slow_constraint": "constraint g_s",
    "force": "force F",
    "control": "control u",
    "fast": "potential on the micro grid",
}
RULES: dict[Any, str] = {"slow_potential": "slow", "fast_potential": "fast", "control": "force"}
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
    microseconds: of its first derivatives at all these nodes once, None where not measured.
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
    """Rows of bodies and effects, and the microseconds of a macro step of the whole scene (None where not measured)."""

    rows: tuple[Row, ...]
    microseconds: float | None = None

    @property
    def unknowns(self) -> int:
        """Unknowns of a macro step, multipliers included: ``r n_s + r n_gs + num_micro r (n_f + n_g)``."""
        return sum(row.unknowns + row.multipliers for row in self.rows)

    def as_dict(self) -> dict[str, Any]:
        """Plain data: "rows", "unknowns", "microseconds"."""
        return asdict(self) | {"rows": [asdict(row) for row in self.rows], "unknowns": self.unknowns}

    def table(self) -> PrintedTable:
        """What each adds; `reasons` says why it is there."""
        table = PrintedTable("name", "part of", "grid", box=None, pad_edge=False)
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
        """What notebooks show: the table."""
        return self.table()._repr_mimebundle_(include, exclude, **kwargs)

    def reasons(self) -> PrintedTable:
        """Why each is slow or fast, and on its grid."""
        table = PrintedTable("name", "why", box=None, pad_edge=False)
        for row in self.rows:
            table.add_row(f"[bold]{row.name}[/bold]", row.why)
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
    sizes = {name: sorting.places[name].size for name in sorting.bodies}
    sizes |= {branch.child: len(branch.joint.freedoms) for branch in sorting.branches}
    for name, pace in sorting.paces.items():
        grid = "micro" if pace.value == "fast" else "macro"
        unknowns = intervals[grid] * sizes[name]
        rows.append(Row(name, "body", grid, f"{pace.value}: {pace.reason}", unknowns, 0, 0))
    whole, times = _measure(sorting, scheme, macro_dt) if measure else (None, [None] * len(sorting.placed))
    for part, nanoseconds in zip(sorting.placed, times, strict=True):
        rule = _rule(one, part.home)
        multipliers = intervals[rule.grid] * sum(build(sorting, [part]).num_constraints(*sorting.start[:2]))
        count = 0 if part.home == "control" else stages * evaluations(rule, one.num_micro)
        own = None if nanoseconds is None else nanoseconds * count / 1e3
        kind = HOMES.get(part.home, f"potential on one in {part.home} micro nodes")
        rows.append(Row(part.effect.name, kind, rule.grid, part.reason, 0, multipliers, count, own))
    return Ledger(tuple(rows), whole)


def _rule(scheme: Scheme, home: Any) -> PlacedRule:
    """The rule of the scheme for what is part of this argument of `System`, or of this one of its further potentials."""
    if home == "fast" or isinstance(home, int):
        return scheme.rule_of(home)
    name: str = RULES.get(home, home)  # pyright: ignore[reportAssignmentType]
    return getattr(scheme, name)


def ledger_of_functions(
    problem: Problem, scheme: Scheme | Composition, macro_dt: float | None = None, measure: bool = True
) -> Ledger:
    """The ledger of a system of functions: its coordinates by name, and each of its functions.

    Args:
        problem: the system and where it starts.
        scheme, macro_dt, measure: as of `Scene.explain`.
    """
    system, state, one = problem.system, problem.state(), stage_scheme(scheme)
    stages = scheme.num_stages if isinstance(scheme, Composition) else 1
    intervals = {"macro": stages * one.degree, "micro": stages * one.degree * one.num_micro}
    names = (problem.names or Names()).of_coordinates(state.q_s.size, state.q_f.size)
    rows = []
    for name, (part, _, size) in names.bodies.items():
        pace, grid = ("fast", "micro") if part == "f" else ("slow", "macro")
        rows.append(Row(name, "body", grid, f"{pace}: it is in q_{part}", intervals[grid] * size, 0, 0))
    terms = [home for home in HOMES if getattr(system, home, None) is not None]
    if system.has_constant_mass:
        terms.remove("kinetic")
    for home in terms:
        alone = _alone(system, home, state)
        rule = _rule(one, home)
        multipliers = intervals[rule.grid] * sum(alone.num_constraints(state.q_s, state.q_f))
        count, time = stages * evaluations(rule, one.num_micro), None
        if measure:
            derivatives = _first_derivatives(alone, state.q_s.size, problem.v_s, problem.v_f)
            time = 1e6 * seconds_each(derivatives, jnp.concatenate([state.q_s, state.q_f])) * count
        why = f"the rule of the scheme for it is on the {rule.grid} grid"
        rows.append(Row(name_of(getattr(system, home)), HOMES[home], rule.grid, why, 0, multipliers, count, time))
    for name, function in system.potentials:
        rule = one.rule_of(name)
        count, time = stages * evaluations(rule, one.num_micro), None
        if measure:
            alone = _alone(system, "", state).replace(potentials={name: function})
            derivatives = _first_derivatives(alone, state.q_s.size, problem.v_s, problem.v_f)
            time = 1e6 * seconds_each(derivatives, jnp.concatenate([state.q_s, state.q_f])) * count
        why = f"the rule of the scheme for it: {rule.in_words()}"
        rows.append(Row(name_of(function), f"potential {label(name)}", rule.grid, why, 0, 0, count, time))
    return Ledger(tuple(rows), _macro_step(system, scheme, state, macro_dt, 10.0) if measure else None)


def _alone(system: System, home: str, state: State) -> System:
    """The system with one of its functions, and unit masses unless that is the kinetic energy."""
    masses = ConstantMass(np.ones(state.q_s.size), np.ones(state.q_f.size))
    others = {name: None for name in HOMES if name not in (home, "kinetic", "control", "fast")}
    others["potentials"] = None
    return system.replace(**others, **({} if home == "kinetic" else {"kinetic": masses}))


def evaluations(rule, num_micro: int) -> int:
    """Nodes of a rule in a macro step, one at the border of two steps counted once."""
    nodes = rule.composite(num_micro).nodes
    shared = np.isclose(nodes[0], 0.0) and np.isclose(nodes[-1], 1.0)
    return len(nodes) - int(shared)


def _measure(sorting: Sorting, scheme, macro_dt) -> tuple[float, list[float]]:
    """Microseconds of a macro step, and nanoseconds of one evaluation of the first derivatives of every effect."""
    system = build(sorting, sorting.placed)
    state = initial_state(system, *sorting.start, project=True)
    step = _macro_step(system, scheme, state, macro_dt, _turning(sorting) or 10.0)
    q_s, q_f, v_s, v_f = sorting.start
    own = [_first_derivatives(build(sorting, [part]), q_s.size, v_s, v_f) for part in sorting.placed]
    q = jnp.concatenate([q_s, q_f])
    return step, [1e9 * seconds_each(derivatives, q) for derivatives in own]


def _macro_step(system: System, scheme, state: State, macro_dt: float | None, otherwise: float) -> float:
    """Microseconds of a macro step; without a step size of one that the fastest vibration, or else this frequency, suggests."""
    if macro_dt is None:
        macro_dt = scheme.num_micro * 0.1 / (float(frequencies(system, state).max(initial=0.0)) or otherwise)
    step = interleaved({"": prepare_steps(system, scheme, state, macro_dt).timed()}, 5)[""]
    return 1e6 * float(np.median(step)) / STEPS


def _turning(sorting: Sorting) -> float:
    """The rate at which the velocities of the start change positions by their own size: that of a body that spins."""
    q_s, q_f, v_s, v_f = (np.abs(x).max(initial=0.0) for x in sorting.start)
    return float(max(v_s, v_f) / max(q_s, q_f, 1e-300))


def _first_derivatives(system: System, n_s: int, v_s, v_f):
    """All first derivatives that a step takes of a system, as a function of its positions that is shaped like these."""

    def lagrangian(q):
        potentials = invariants.potential_energy(system, q[:n_s], q[n_s:])
        if system.has_constant_mass:
            return -potentials
        return system.kinetic(q[:n_s], q[n_s:], v_s, v_f, system.params) - potentials

    def derivatives(q):
        found = jax.grad(lagrangian)(q)
        if system.is_constrained:
            found += jax.jacrev(lambda q: system.constraints(0.0, q[:n_s], q[n_s:]))(q).sum(axis=0)
        if system.force is not None:
            found += jnp.concatenate(system.forces(0.0, q[:n_s], q[n_s:], v_s, v_f))
        return found

    return derivatives


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

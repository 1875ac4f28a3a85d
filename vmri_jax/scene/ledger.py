"""The ledger of a scene or of a system of functions: grid, unknowns, evaluations and computing time of every body and
effect."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics import invariants
from vmri_jax.mechanics.arrays import split_at
from vmri_jax.mechanics.linearisation import linearise
from vmri_jax.mechanics.masses import ConstantMass
from vmri_jax.mechanics.names import Names
from vmri_jax.mechanics.state import Problem, initial_state
from vmri_jax.mechanics.surroundings import name_of
from vmri_jax.mechanics.system import System
from vmri_jax.mechanics.terms import KINDS
from vmri_jax.refusals import Refused
from vmri_jax.running.prepare import prepare
from vmri_jax.running.printed import PrintedTable
from vmri_jax.running.timing import interleaved, seconds_each
from vmri_jax.scene.functions import build
from vmri_jax.scene.sorting import Sorting
from vmri_jax.schemes.composition import Composition, stage_scheme
from vmri_jax.schemes.scheme import Scheme

STEPS = 20
"""Macro steps of the program that is timed: enough that the call of the program takes little of the time.

More take longer.
"""
DEFAULT_FREQUENCY = 10.0
"""rad/s, from which the step size of a timed step follows if the system neither vibrates nor turns.

A larger one takes smaller steps.
"""


@dataclass(frozen=True)
class LedgerRow:
    """A body or effect in the ledger.

    kind: "body", or the term that the effect is part of.
    grid, why: "macro" or "micro", the grid of its unknowns or evaluations, and the reason for it.
    unknowns, multipliers: how many of each it adds to the equations of a macro step.
    evaluations: number of nodes in a macro step at which its function is evaluated (by implicit schemes in every Newton
        iteration).
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
    """Rows of bodies and effects, and the computing time of a macro step of the whole scene in microseconds
    (None if not measured)."""

    rows: tuple[LedgerRow, ...]
    microseconds: float | None = None

    @property
    def unknowns(self) -> int:
        """Unknowns and multipliers of all stages of a macro step: ``r (n_s + n_gs + num_micro (n_f + n_g))`` for each,
        with degree r and rows n_gs of g_s, n_g of g."""
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
    sizes = {name: place.size for name, place in sorting.layout.bodies.items()}
    sizes |= {branch.child: len(branch.joint.freedoms) for branch in sorting.branches}
    bodies = [(name, sizes[name], pace.value, pace.reason) for name, pace in sorting.paces.items()]
    functions = [
        (part.effect.name, *_term(part.home), part.reason, build(sorting, [part]), part.home != "control")
        for part in sorting.placed
    ]
    system = build(sorting, sorting.placed)
    return _ledger(bodies, functions, system, sorting.start, scheme, macro_dt, measure)


def _term(home: Any) -> tuple[Any, str]:
    """The key of the rule in `Scheme.rule_of`, and the name, of the term of a scene that an effect is part of."""
    if home in KINDS:
        kind = KINDS[home]
        return kind.symbol, f"{kind.in_words} {kind.symbol}"
    if home == "control":
        return "F", "control u"
    return home, "potential on the micro grid" if home == "fast" else f"potential on one in {home} micro nodes"


def ledger_of_functions(
    problem: Problem, scheme: Scheme | Composition, macro_dt: float | None = None, measure: bool = True
) -> Ledger:
    """The ledger of a system of functions: its coordinates by name, and each of its functions; see `Scene.explain`."""
    system, state = problem.system, problem.state()
    names = (problem.names or Names()).of_coordinates(state.q_s.size, state.q_f.size)
    bodies = [
        (name, size, "fast" if part == "f" else "slow", f"it is in q_{part}")
        for name, (part, _, size) in names.bodies.items()
    ]
    masses = ConstantMass(np.ones(state.q_s.size), np.ones(state.q_f.size))
    functions = []
    for term in system.terms:
        # T_s is a part of the row of T; masses cost nothing, and steps do not solve for implied rows
        if term.kind == "implied" or term.name == "T_s" or isinstance(term.function, ConstantMass):
            continue
        alone = {other.name: other.function for other in system.terms if other.kind == term.kind == "kinetic"}
        alone = {"T": masses} | alone | {term.name: term.function}
        kind, system_alone = (
            f"{KINDS[term.field].in_words} {term.label}",
            system.mapped(lambda t, f=alone: f.get(t.name)),
        )
        functions.append((name_of(term.function), term.name, kind, "", system_alone, True))
    start = state.q_s, state.q_f, problem.v_s, problem.v_f
    return _ledger(bodies, functions, system, start, scheme, macro_dt, measure)


def _ledger(bodies, functions, system: System, start, scheme, macro_dt: float | None, measure: bool) -> Ledger:
    """The ledger of a system.

    Args:
        bodies: (name, number of coordinates, pace, reason for it).
        functions: (name, key of its rule, name of its kind, reason for its grid, the system with this function alone,
            whether steps evaluate it).
        start: (q_s, q_f, v_s, v_f), where the functions are measured.
    """
    stage, stages = stage_scheme(scheme), scheme.num_stages if isinstance(scheme, Composition) else 1
    nodes = {"macro": stages * stage.degree, "micro": stages * stage.degree * stage.num_micro}  # with unknowns
    rows = []
    for name, size, pace, reason in bodies:
        grid = "micro" if pace == "fast" else "macro"
        rows.append(LedgerRow(name, "body", grid, f"{pace}: {reason}", nodes[grid] * size, 0, 0))
    q = np.concatenate(start[:2])
    for name, key, kind, reason, alone, is_evaluated in functions:
        rule = stage.rule_of(key)
        reason = reason or f"the rule of the scheme for it: {rule.in_words()}"
        multipliers = nodes[rule.grid] * sum(alone.num_constraints(*start[:2]))
        count, microseconds = is_evaluated * stages * rule.evaluations(stage.num_micro), None
        if measure:
            microseconds = 1e6 * count * seconds_each(_first_derivatives(alone, start[0].size, *start[2:]), q)
        rows.append(LedgerRow(name, kind, rule.grid, reason, 0, multipliers, count, microseconds))
    return Ledger(tuple(rows), _macro_step(system, scheme, start, macro_dt) if measure else None)


def _macro_step(system: System, scheme, start, macro_dt: float | None) -> float:
    """Microseconds of a macro step, by default of micro steps 0.1 / w, w the largest frequency."""
    state = initial_state(system, *start, project=True)
    if macro_dt is None:
        largest_q, largest_v = (max(np.abs(x).max(initial=0.0) for x in pair) for pair in (start[:2], start[2:]))
        turning = float(largest_v / max(largest_q, 1e-300))  # rad/s; of a spinning body roughly its angular velocity
        frequency = float(linearise(system, state).frequencies.max(initial=0.0)) or turning or DEFAULT_FREQUENCY
        macro_dt = scheme.num_micro * 0.1 / frequency
    steps = prepare(system, scheme, state, macro_dt=macro_dt, num_steps=STEPS, save=STEPS)
    seconds = interleaved({"": steps.timed()}, 5)[""]
    return 1e6 * float(np.median(seconds)) / STEPS


def _first_derivatives(system: System, n_s: int, v_s, v_f):
    """All first derivatives of a system that a step takes, added up, as a function of its positions q (n,) that returns
    (n,)."""

    def lagrangian(q):
        q_s, q_f = split_at(q, n_s)
        potentials = invariants.potential_energy(system, q_s, q_f)
        return -potentials if system.has_constant_mass else system.kinetic_energy(q_s, q_f, v_s, v_f) - potentials

    def derivatives(q):
        (q_s, q_f), total = split_at(q, n_s), jax.grad(lagrangian)(q)
        if system.is_constrained:
            total += jax.jacrev(lambda q: system.constraints(0.0, *split_at(q, n_s)))(q).sum(axis=0)
        if system.force is not None:
            total += jnp.concatenate(system.forces(0.0, q_s, q_f, v_s, v_f))
        return total

    return derivatives

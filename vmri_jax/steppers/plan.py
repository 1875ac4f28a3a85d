"""The plan: which steppers take a macro step of a system under a scheme, decided once, from structure alone.

The plan chooses the cheapest stepper that the rules and the system allow, from outside to inside:

* *composed*: a composition runs its stage over parts of the step;
* *kicked*: potentials at the ends of the interval only shift momenta, before and after the motion inside;
* *decoupled*: where no term but kicks couples slow and fast variables, the slow variables make one step over the macro
  interval and the fast variables num_micro steps over the micro intervals; each part is planned like a whole system.
  Potentials on every k-th micro node kick between groups of k fast steps (*repeated*);
* *joined*: on one micro interval slow and fast unknowns are of one kind, so that all variables count as fast;
* *free flight*: only kinetic energy of constant masses is left;
* *linear*: only fast variables with linear equations are left;
* else an iteration, by the matrix of `Solver`: masses and constraints, for the multipliers of a drift alone (*Rattle*)
  or for the micro intervals in order (*nested*, with masses that vary *march*); modes of time, for one interval of high
  degree (*collocation*); or exact (*march*), which is also the *fallback* of the others.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import pairwise
from typing import Any

import jax.numpy as jnp

from vmri_jax.kernels import COLLOCATES, DRIFTS, LARGEST_RENEWED
from vmri_jax.mechanics.constraint_pattern import all_rows
from vmri_jax.mechanics.state import Movable, State, start_of
from vmri_jax.mechanics.structure import depends_on
from vmri_jax.mechanics.system import System
from vmri_jax.mechanics.terms import POSITIONS
from vmri_jax.refusals import Refused
from vmri_jax.schemes.composition import Composition, stage_scheme
from vmri_jax.schemes.discrete_lagrangian import PlacedTerm, lagrangian, placed_potentials
from vmri_jax.schemes.quadrature import macro
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.collocation import Collocation
from vmri_jax.steppers.composed import Composed
from vmri_jax.steppers.custom import check_shapes, with_kicks
from vmri_jax.steppers.decoupled import Decoupled, Joined
from vmri_jax.steppers.direct import FreeFlight, Linear
from vmri_jax.steppers.interval import SMALL, IntervalStructure, implicit_terms
from vmri_jax.steppers.kicked import Kicked, Repeated, average_over_fast_motion
from vmri_jax.steppers.marched import Marched
from vmri_jax.steppers.nested import Nested
from vmri_jax.steppers.rattle import Rattle
from vmri_jax.steppers.solved import Solved, StepSolver
from vmri_jax.steppers.solver import Solver
from vmri_jax.steppers.stepper import StepInfo, Stepper, indented
from vmri_jax.steppers.subsystems import frozen_slow, joined, part_alone

Parts = tuple[list[PlacedTerm], dict[int, list[PlacedTerm]]]
"""Potentials of the slow variables, on the macro grid, and of the fast variables, by the number k of micro intervals
that a copy of their rule spans; the keys k increase, start with 1, and each is a multiple of the one before."""


@dataclass(frozen=True)
class Plan:
    """A stepper with its system and scheme: ``memory = init(state, dt)``, then
    ``state, info, memory = step(state, memory, dt)``.

    ``print`` shows it in words, ``print(plan.describe())`` with the rules of the scheme.

    Attributes:
        system, scheme, solver: arguments of `plan`.
        stepper: the tree of steppers.
    """

    system: System
    scheme: Scheme | Composition
    solver: Solver
    stepper: Stepper

    def init(self, state: State, macro_dt):
        """The memory of the first step."""
        return self.stepper.init(state, macro_dt)

    def step(self, state: State, memory, macro_dt) -> tuple[State, StepInfo, Any]:
        """One macro step."""
        return self.stepper.step(state, memory, macro_dt)

    @property
    def has_fallback(self) -> bool:
        """Whether the steps are taken by another matrix than the exact one, which "auto" has chosen: a run with
        `Solver.exact` may solve what fails."""
        chosen = self.solver.matrix == "auto" and self.solver.stepper is None
        return chosen and not all(solver.is_exact for solver in _solvers(self.stepper))

    @property
    def first(self) -> Solver:
        """The solver with the matrix that "auto" has chosen by its name, without a fallback."""
        modes = any(isinstance(solver, Collocation) for solver in _solvers(self.stepper))
        return replace(self.solver, matrix="modes" if modes else "masses") if self.has_fallback else self.solver

    def describe(self) -> str:
        """The scheme applied to the system in words: rules of the terms that the system has, order, symmetry, and the
        steppers."""
        system = self.system
        has = {term.label for term in system.terms}
        scheme = with_rules_for(system, self.scheme).describe()
        rules = {name: rule for name, rule in scheme.rules.items() if name in has}
        if system.slow_kinetic is not None:
            slow = macro(stage_scheme(self.scheme).kinetic.rule).in_words()
            rules = {"T": rules.pop("T"), "T_s": slow} | rules
        scheme = replace(scheme, rules=rules)
        return "\n".join([str(scheme), "a step:", *indented(str(self).splitlines())])

    def __str__(self) -> str:
        again = ["what that does not solve: exact, micro intervals in order with exact matrices"]
        return "\n".join(self.stepper.describe() + again * self.has_fallback)


def plan(
    system: Movable,
    scheme: Scheme | Composition,
    state: State | None = None,
    solver: Solver | None = None,
) -> Plan:
    """The plan of macro steps of a system under a scheme; ``print`` shows it in words.

    Args:
        system: a `Problem` or a scene, or a `System` with a state.
        scheme: a `Scheme` or a `Composition`.
        state: any state of the system; only the shapes of its arrays matter.
        solver: for implicit equations, by default ``Solver()``. The plan of the matrix "auto" has the first matrix that
            the structure allows; runs solve again what it does not solve (`vmri_jax.running.engine`).

    Raises:
        ValueError: a matrix that the system or the scheme does not allow; a scheme that the system does not allow.
    """
    system, state = start_of("plan", system, state)
    solver, stage = solver or Solver(), stage_scheme(scheme)
    custom = None if solver.stepper is None else solver.stepper.called(system, stage)
    if solver.stepper is None or isinstance(custom, StepSolver):
        stepper: Stepper = _whole_step(system, stage, solver, state.q_s, state.q_f)
    else:
        stepper = with_kicks(custom, system, stage, _average(system, stage, Solver()))
    if solver.stepper is not None:
        check_shapes(stepper, system, stage, state)
    if isinstance(scheme, Composition):
        stepper = Composed(scheme.coefficients, stepper)
    return Plan(system, scheme, solver, stepper)


def _solvers(stepper: Stepper) -> list[StepSolver]:
    """The solvers of a tree of steppers."""
    if isinstance(stepper, Solved):
        return [stepper.solver]
    inner = [getattr(stepper, name) for name in ("stage", "inner", "slow", "fast") if hasattr(stepper, name)]
    return [solver for part in inner for solver in _solvers(part)]


def _whole_step(system: System, scheme: Scheme, solver: Solver, q_s, q_f) -> Kicked:
    """Kicks, and the stepper between them."""
    kicks = lagrangian(system, scheme).kicks
    average = _average(system, scheme, solver)
    parts = _apart(system, scheme, q_s, q_f)
    if parts is not None:
        between = _decoupled(system, scheme, solver, q_s, q_f, parts)
        # Kicks of terms at the macro nodes alone stay here. All other terms, on the micro grid or with further nodes
        # inside, belong to the slow or the fast part, with their kicks.
        kicks = tuple(term for term in kicks if term.grid == "macro" and not len(term.inside.c))
        return Kicked(kicks, between, average)
    return Kicked(kicks, _between_kicks(system, scheme, solver, q_s, q_f), average)


def _between_kicks(system: System, scheme: Scheme, solver: Solver, q_s, q_f, num_slow: int = 0) -> Stepper:
    """The stepper of all that moves between kicks; of joined variables the first `num_slow` are slow."""
    can_be_nested, rows = _can_be_nested(system, scheme), all_rows(system, q_s, q_f)
    _check_matrix(solver.matrix, system, scheme, can_be_nested)
    if _is_drift(system, scheme) and not system.is_constrained:
        return FreeFlight(system)
    if solver.stepper is not None:
        custom = solver.stepper.called(system, scheme)
        return Solved(system, scheme, custom, rows)
    # the structure of a micro interval, found where it is needed, once
    interval = cache(partial(IntervalStructure.of, system, scheme, q_s, q_f))
    if q_s.size and _joins(system, scheme, solver, interval, q_s.size, q_f.size):
        (n_g, _), q = system.num_constraints(q_s, q_f), jnp.concatenate([q_s, q_f])
        num_slow = q_s.size if q_f.size else 0  # of slow variables alone the Hessian has all
        together = _between_kicks(*joined(system, scheme, q_s.size), solver, jnp.zeros(0), q, num_slow)
        return Joined(together, q_s.size, n_g)
    if not can_be_nested or solver.matrix in ("exact", "null_space"):
        n_g, n_gs = system.num_constraints(q_s, q_f)
        first = "exact" if system.has_constant_mass else "masses"
        chosen = replace(solver, matrix=first) if solver.matrix == "auto" else solver
        marched = Marched(chosen, (q_s.size, n_gs, q_f.size, n_g, scheme.degree))
        return Solved(system, scheme, marched, rows)
    if _is_linear(system, scheme, interval(), q_s):
        return Linear(system, scheme, interval())
    # modes and drifts know fast variables alone (`_joins`); Nested keeps a larger matrix over many steps
    modes = COLLOCATES and not q_s.size and q_f.size <= SMALL and _has_modes(system, scheme)
    if solver.matrix == "modes" or (solver.matrix == "auto" and modes and not interval().is_diagonal):
        return Solved(system, scheme, Collocation(solver, num_slow), rows)
    is_drift = DRIFTS and _is_drift(system, scheme)
    return Solved(system, scheme, Rattle(solver, rows) if is_drift else Nested(solver, interval()), rows)


def _joins(
    system: System, scheme: Scheme, solver: Solver, interval: Callable[[], IntervalStructure], n_s: int, n_f: int
) -> bool:
    """Whether slow and fast variables are unknowns of one kind: on one micro interval, where the nested iteration does
    not keep to smaller matrices.

    Of many variables it keeps a matrix of the fast ones alone, of a diagonal K one number for each, and it solves for
    slow variables alone by their masses.
    """
    nested = _can_be_nested(system, scheme) and solver.matrix in ("auto", "masses") and not _is_drift(system, scheme)
    if scheme.num_micro > 1 or not nested:
        return scheme.num_micro == 1
    if _has_modes(system, scheme):
        return n_s + n_f <= SMALL
    return n_f > 0 and n_s + n_f <= LARGEST_RENEWED and not interval().is_diagonal


def _check_matrix(matrix: str, system: System, scheme: Scheme, can_be_nested: bool) -> None:
    """Refuse a matrix that the structure of the system and the scheme does not allow."""
    if matrix == "modes" and not system.has_constant_mass:
        raise Refused(
            "Solver: the matrix 'modes' needs a System whose kinetic is a ConstantMass. Take 'auto' or 'exact'."
        )
    if matrix in ("masses", "modes") and system.has_constant_mass and not can_be_nested:
        raise Refused(
            f"Solver: the matrix {matrix!r} needs potentials and forces on the micro grid, or as kicks at the macro "
            "nodes or at every k-th micro node; a term of this scheme has other nodes inside the macro interval. "
            "Take the matrix 'auto' or 'exact'."
        )
    if matrix == "modes" and not _has_modes(system, scheme):
        raise Refused(
            "Solver: the matrix 'modes' needs a scheme with num_micro = 1 and a degree above 1, such as galerkin(1, "
            f"3), and a System without force; here num_micro = {scheme.num_micro}, degree = {scheme.degree}. Take the "
            "matrix 'auto' or 'exact'."
        )


def _has_modes(system: System, scheme: Scheme) -> bool:
    """Whether the equations of one interval decouple in modes of time."""
    return scheme.num_micro == 1 and scheme.degree > 1 and system.force is None


def _can_be_nested(system: System, scheme: Scheme) -> bool:
    """Whether masses are constant, and every term has its nodes inside single micro intervals or at nodes where they
    meet."""
    local = all(rule.is_local or rule.only_ends for _, rule in placed_potentials(system, scheme))
    force = system.force is None or scheme.force.grid == "micro"
    return system.has_constant_mass and local and force


def _is_drift(system: System, scheme: Scheme) -> bool:
    """Whether, apart from kicks, a single micro interval has kinetic energy of constant masses and constraints
    alone."""
    is_free = system.has_constant_mass and system.force is None and not implicit_terms(system, scheme)
    return scheme.num_micro == scheme.degree == 1 and is_free


def _is_linear(system: System, scheme: Scheme, interval: IntervalStructure, q_s) -> bool:
    """Whether only the fast equations of one interval are left, and K is their exact, constant matrix.

    A diagonal K is exact only if all implicit terms are functions of q_f alone.
    """
    alone = not system.is_constrained and system.force is None and not q_s.shape[0] and scheme.num_micro == 1
    complete = all(term.arguments == ("q_f",) for term in implicit_terms(system, scheme))
    return alone and interval.is_constant and (complete or not interval.is_diagonal)


def _apart(system: System, scheme: Scheme, q_s, q_f) -> Parts | None:
    """The potentials with nodes inside the macro interval, if no term but kicks couples slow and fast variables.

    None if the variables must be solved for together: a term depends on slow and fast variables, or a potential has
    nodes between the steps of its part (a slow potential on the micro grid, copies of rules whose lengths do not divide
    each other).
    """
    if scheme.degree > 1 or system.force is not None or not system.has_constant_mass:
        return None
    if scheme.num_micro == 1 and not q_s.shape[0]:
        return None  # fast variables on one interval: nothing to take apart, as in the parts of a decoupled system
    slow, fast = [], {1: []}
    for potential in placed_potentials(system, scheme):
        term, rule = potential
        if rule.only_kicks:
            continue
        seen = depends_on(lambda *q, term=term: term.at(q, system.params), q_s, q_f)  # all, by a function that prints
        sees_slow, sees_fast = (used and name in term.arguments for name, used in zip(POSITIONS, seen, strict=True))
        if rule.grid == "macro":
            if term.name == "W" or sees_fast:
                return None
            slow.append(potential)
        elif term.name == "V" and rule.every == 1:
            return None
        else:
            if (sees_slow and q_s.size) or (rule.every > 1 and not rule.only_ends):
                return None
            fast.setdefault(rule.every, []).append(potential)
    fast = dict(sorted(fast.items()))
    is_chain = all(longer % shorter == 0 for shorter, longer in pairwise(fast))
    coupled = not is_chain or depends_on(lambda q: system.g(jnp.zeros(()), q, q_f), q_s)[0]
    return None if coupled else (slow, fast)


def _decoupled(system: System, scheme: Scheme, solver: Solver, q_s, q_f, potentials: Parts) -> Decoupled:
    (of_slow, of_fast), none = potentials, jnp.zeros(0)
    slow, slow_scheme = part_alone(system, "slow", of_slow, num_other=q_f.size)
    parts = {every: part_alone(system, "fast", further, num_other=q_s.size) for every, further in of_fast.items()}
    fast, length = _whole_step(*parts.pop(1), solver, none, q_f), 1
    for every, part in parts.items():
        fast = Kicked(lagrangian(*part).kicks, Repeated(fast, every // length))
        length = every
    return Decoupled(_whole_step(slow, slow_scheme, solver, none, q_s), Repeated(fast, scheme.num_micro // length))


def with_rules_for(system: System, scheme: Scheme | Composition) -> Scheme | Composition:
    """The scheme with an explicit rule for each of `System.potentials`, also for those whose name implies the rule."""
    if isinstance(scheme, Composition):
        return replace(scheme, scheme=with_rules_for(system, scheme.scheme))
    further = (term for term in system.terms if term.field == "potentials")
    return replace(scheme, potentials={term.label: scheme.rule_of(term.name) for term in further})


def _average(system: System, scheme: Scheme, solver: Solver) -> Callable | None:
    """The filter of a mollified slow potential, None if the slow potential is not mollified."""
    if not scheme.slow.mollified:
        return None
    on_micro_grid = [str(name) for name in system.potentials if not scheme.rule_of(name).only_kicks]
    if scheme.fast.every > 1 or on_micro_grid:
        every = f"W has nodes on every {scheme.fast.every}th micro node" if scheme.fast.every > 1 else ""
        others = every or f"the potentials {', '.join(on_micro_grid)} are on the micro grid"
        raise Refused(
            f"Scheme: the slow potential is mollified, which averages over the motion under W alone; here {others}. "
            "Give W the rule micro(...) and the others macro(trapezoidal), or take a scheme without mollified kicks, "
            "e.g. explicit_slow(num_micro)."
        )
    if not system.has_constant_mass or system.is_rheonomic:
        raise Refused(
            "Scheme: a mollified slow potential needs a System whose kinetic is a ConstantMass, without Rheonomic "
            "constraints."
        )

    def stepper_of(q_s, q_f) -> Kicked:
        alone, rules = frozen_slow(system, scheme, q_s)
        return _whole_step(alone, rules, solver, jnp.zeros(0), q_f)

    return average_over_fast_motion(stepper_of, scheme.num_micro)

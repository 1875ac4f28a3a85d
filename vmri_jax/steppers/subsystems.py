"""Decoupled parts of a system, and all of its variables joined: systems in which all variables count as fast, on a
single interval.

Slow variables of a part are stored as q_f, joined ones as ``(q_s, q_f)`` in q_f.

The functions of these systems are dataclasses. They compare by value, so that JAX traces equal ones once.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax.numpy as jnp

from vmri_jax.mechanics.arrays import split_at
from vmri_jax.mechanics.functions import Rheonomic
from vmri_jax.mechanics.masses import ConstantMass, WithMassMatrix
from vmri_jax.mechanics.projection import closed_masses, have_closed_masses
from vmri_jax.mechanics.system import RATE_OF, System
from vmri_jax.mechanics.terms import KINDS, POSITIONS, Term
from vmri_jax.schemes.discrete_lagrangian import PlacedTerm, placed_potentials
from vmri_jax.schemes.quadrature import micro, midpoint
from vmri_jax.schemes.scheme import Scheme


@dataclass(frozen=True)
class OfPart:
    """A term that depends on one part alone, as a function of the fast variables of that part, with the time first if
    it is a constraint.

    positions, other: names of the positions of the part and of all others.
    num_other: number of the others, which the term gets as zeros.
    """

    term: Term
    positions: str
    other: str
    num_other: int

    def __call__(self, *arguments):
        *_, q, params = arguments
        return self.term(params, **{"t": arguments[0], self.positions: q, self.other: jnp.zeros(self.num_other)})


def part_alone(system: System, part: str, potentials: Sequence[PlacedTerm], num_other: int) -> tuple[System, Scheme]:
    """The system of the slow or of the fast variables, and the scheme of a step: of slow variables over the macro
    interval, of fast ones over the k micro intervals that the rules of the potentials span.

    Args:
        system: the whole one.
        part: "slow" or "fast".
        potentials: of the variables of the part alone; W, or else V, becomes the fast potential of the new system.
        num_other: number of all other variables.
    """
    constraint = "slow_constraint" if part == "slow" else "constraint"
    positions, other = POSITIONS if part == "slow" else POSITIONS[::-1]
    alone = partial(OfPart, positions=positions, other=other, num_other=num_other)
    main = next((placed for name in ("W", "V") for placed in potentials if placed.term.name == name), None)
    further = {placed.term.label: placed for placed in potentials if placed is not main}
    if "V" in further:  # beside W a potential must not be called V, nor as any other one
        further["V beside " + ", ".join(further)] = further.pop("V")
    rows = (Rheonomic(alone(term)) for term in system.terms if term.field == constraint)
    of_part = System(
        ConstantMass(jnp.zeros(0), getattr(system.kinetic, part)),
        fast_potential=None if main is None else alone(main.term),
        constraint=next(rows, None),
        params=system.params,
        potentials={name: alone(term) for name, (term, _) in further.items()},
    )
    drift = micro(midpoint)
    fast = drift if main is None else replace(main.rule, grid="micro", every=1)
    rules = {name: micro(placed.rule) for name, (_, placed) in further.items()}
    return of_part, Scheme(1, kinetic=drift, slow=drift, fast=fast, potentials=rules)


@dataclass(frozen=True)
class OfJoined(WithMassMatrix):
    """The sum of energies, the joined rows of constraints, or the forces, as a function of joined variables.

    terms: of one kind.
    arguments: names of its arguments without params; q_f and v_f are the joined variables, q_s and v_s have size 0.
    """

    terms: tuple[Term, ...]
    arguments: tuple[str, ...]
    num_slow: int

    def __call__(self, *arguments):
        *values, params = arguments
        values = dict(zip(self.arguments, values, strict=True))
        for slow, fast in (("q_s", "q_f"), ("v_s", "v_f")):
            if fast in values:
                values[slow], values[fast] = split_at(values[fast], self.num_slow)
        first, *others = (term(params, **values) for term in self.terms)
        if self.terms[0].kind == "force":
            return jnp.zeros(0), jnp.concatenate(first)
        return jnp.concatenate([first, *others]) if self.terms[0].kind == "constraint" else sum(others, first)

    @property
    def has_mass_matrix(self) -> bool:
        return have_closed_masses(self.terms)

    def mass_matrix(self, q_s, q_f, params, *others):
        return closed_masses(self.terms, *split_at(q_f, self.num_slow), params)


def joined(system: System, scheme: Scheme, num_slow: int) -> tuple[System, Scheme]:
    """All variables as fast ones, and the scheme of their step on one micro interval, without potentials that only
    kick.

    Args:
        system, scheme: the whole ones.
        num_slow: number of slow variables.
    """
    inside = [(term, rule) for term, rule in placed_potentials(system, scheme) if not rule.only_ends]
    functions: dict[Any, Any] = {}
    potentials: dict[Any, Any] = {}
    for term in [*(term for term, _ in inside), *system.of_kind("force")]:
        place, name = (potentials, term.name) if term.field == "potentials" else (functions, term.field)
        place[name] = OfJoined((term,), term.arguments, num_slow)
    if system.is_constrained:
        functions["constraint"] = Rheonomic(OfJoined(system.of_kind("constraint"), ("t", *POSITIONS), num_slow))
    if system.has_constant_mass:
        masses = system.kinetic
        kinetic = ConstantMass(jnp.zeros(0), jnp.concatenate(masses.diagonal) if masses.is_diagonal else masses.matrix)
    else:
        kinetic = OfJoined(system.of_kind("kinetic"), KINDS["kinetic"].arguments, num_slow)
    together = System(kinetic, **functions, params=system.params, potentials=potentials)

    rules: dict[Any, Any] = {"slow": scheme.kinetic, "fast": scheme.kinetic, "potentials": {}}
    for term, rule in inside:
        place, name = (rules["potentials"], term.name) if term.field == "potentials" else (rules, RATE_OF[term.name])
        place[name] = micro(rule.rule)
    rules |= {"kinetic": scheme.kinetic, "constraint": scheme.constraint, "force": micro(scheme.force.rule)}
    return together, Scheme(1, scheme.degree, **rules)


@dataclass(frozen=True)
class AtRest:
    """W, or g with the slow variables at rest, as a function with the parameters ``(params, q_s)``."""

    term: Term

    def __call__(self, *arguments):
        q, (params, q_s) = arguments[-2:]
        return self.term(params, q_s=q_s, q_f=q)


def frozen_slow(system: System, scheme: Scheme, q_s) -> tuple[System, Scheme]:
    """The system of the fast variables under W and g with the slow variables at rest in q_s, and the scheme of one
    micro interval."""
    functions: dict[str, Any] = {
        term.field: AtRest(term) for term in system.terms if term.field in ("fast_potential", "constraint")
    }
    alone = System(ConstantMass(jnp.zeros(0), system.kinetic.fast), **functions, params=(system.params, q_s))
    rule = micro(scheme.kinetic.rule)
    return alone, Scheme(1, scheme.degree, kinetic=rule, slow=rule, fast=scheme.fast)

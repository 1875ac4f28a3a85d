"""The parts of a macro step: what can be taken apart, decided statically from the rules and the system."""

from typing import NamedTuple

import jax.numpy as jnp

from vmri_jax.mechanics.structure import depends_on
from vmri_jax.mechanics.system import ConstantMass, Rheonomic, System
from vmri_jax.schemes.discrete_lagrangian import Term, lagrangian
from vmri_jax.schemes.quadrature import PlacedRule, micro, midpoint
from vmri_jax.schemes.scheme import Scheme


class Split(NamedTuple):
    """A system taken apart: a slow system for one step, a fast one for num_micro steps; kicks at the macro nodes stay outside.

    Each part is a system of fast variables alone on a single micro interval.
    """

    slow: System
    slow_scheme: Scheme
    fast: System
    fast_scheme: Scheme


def split(system: System, scheme: Scheme, q_s, q_f) -> Split | None:
    """The parts of a macro step whose slow equations, kicks aside, do not see the fast unknowns, else None."""
    n_s, n_f = q_s.shape[0], q_f.shape[0]
    params = system.params
    if scheme.degree > 1 or system.force is not None or not isinstance(system.kinetic, ConstantMass):
        return None
    if scheme.num_micro == 1 and not n_s:
        return None  # a part already
    slow_potential, fast_potential = system.slow_potential, system.fast_potential
    if scheme.slow.grid == "macro" and scheme.slow.only_ends:
        slow_potential = None
    if scheme.fast.grid == "macro" and scheme.fast.only_ends:
        fast_potential = None

    coupled_slow = slow_potential is not None and (
        scheme.slow.grid == "micro" or depends_on(lambda q: slow_potential(q_s, q, params), q_f)[0]
    )
    coupled_fast = fast_potential is not None and scheme.fast.grid == "macro"
    coupled_constraint = depends_on(lambda q: system.g(jnp.zeros(()), q, q_f), q_s)[0]
    if coupled_slow or coupled_fast or coupled_constraint:
        return None

    def potential_of_slow(q, params):
        return slow_potential(q, jnp.zeros(n_f), params)  # pyright: ignore[reportOptionalCall]

    @Rheonomic
    def constraint_of_slow(t, _, q, params):
        return system.replace(params=params).g_slow(t, q)

    @Rheonomic
    def constraint_of_fast(t, _, q, params):
        return system.replace(params=params).g(t, jnp.zeros(n_s), q)

    none, drift = jnp.zeros(0), micro(midpoint)
    return Split(
        slow=System(
            ConstantMass(none, system.kinetic.slow),
            fast_potential=None if slow_potential is None else potential_of_slow,
            constraint=None if system.slow_constraint is None else constraint_of_slow,
            params=params,
        ),
        slow_scheme=Scheme(1, kinetic=drift, slow=drift, fast=PlacedRule(scheme.slow.rule, scheme.slow.grid)),
        fast=System(
            ConstantMass(none, system.kinetic.fast),
            fast_potential=fast_potential,
            constraint=None if system.constraint is None else constraint_of_fast,
            params=params,
        ),
        fast_scheme=Scheme(1, kinetic=drift, slow=drift, fast=scheme.fast),
    )


def macro_kicks(system: System, scheme: Scheme, parts: Split | None) -> tuple[Term, ...]:
    """The terms that shift the momenta before and after all else of a macro step; of the others its parts take care."""
    kicks = lagrangian(system, scheme).kicks
    if parts is None:
        return kicks
    return tuple(term for term in kicks if term.grid == "macro" and not term.inside.groups)


def fast_alone(system: System, scheme: Scheme, q_s) -> tuple[System, Scheme]:
    """The fast variables under W and g with the slow ones at rest in q_s, and the scheme of one micro interval of them."""
    assert isinstance(system.kinetic, ConstantMass)
    fast_potential = system.fast_potential

    def potential(q, at):
        return fast_potential(q, at[0])  # pyright: ignore[reportOptionalCall]

    def constraint_at_rest(_, q, at):
        return system.replace(params=at[0]).g(jnp.zeros(()), at[1], q)

    alone = System(
        ConstantMass(jnp.zeros(0), system.kinetic.fast),
        fast_potential=None if fast_potential is None else potential,
        constraint=None if system.constraint is None else constraint_at_rest,
        params=(system.params, q_s),
    )
    rule = micro(scheme.kinetic.rule)
    return alone, Scheme(1, scheme.degree, kinetic=rule, slow=rule, fast=scheme.fast)


def is_drift(system: System, scheme: Scheme) -> bool:
    """Whether on a single micro interval, kicks aside, only kinetic energy of constant masses and constraints are left."""
    terms = lagrangian(system, scheme).terms
    return (
        scheme.num_micro == scheme.degree == 1
        and isinstance(system.kinetic, ConstantMass)
        and system.force is None
        and not any(term.inside.groups for term in terms if isinstance(term, Term))
    )


def drifts(system: System, scheme: Scheme, q_s, q_f) -> bool:
    """Whether nothing but drifts moves along constraints: these also take momenta that are not projected."""
    parts = split(system, scheme, q_s, q_f)
    if parts is None:
        return is_drift(system, scheme)
    pairs = (parts.slow, parts.slow_scheme), (parts.fast, parts.fast_scheme)
    return all(is_drift(part, rules) for part, rules in pairs if part.is_constrained)


def is_explicit(system: System, scheme: Scheme) -> bool:
    """Whether a step is a straight drift between kicks."""
    return is_drift(system, scheme) and not system.is_constrained

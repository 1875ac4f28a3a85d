"""Decoupled parts of a system: the slow and the fast variables as systems of their own, in which all variables count as fast.

Each part moves on a single interval; slow variables are stored as q_f.

The functions of the parts are dataclasses. They compare by value, so that JAX traces equal ones once.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import jax.numpy as jnp

from vmri_jax.mechanics.functions import Rheonomic, with_time
from vmri_jax.mechanics.masses import ConstantMass
from vmri_jax.mechanics.system import System
from vmri_jax.schemes.discrete_lagrangian import PlacedPotential
from vmri_jax.schemes.quadrature import PlacedRule, micro, midpoint
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.interval import constant_mass


@dataclass(frozen=True)
class OfPart:
    """A function of a system that depends on one part alone, as a function of the fast variables of that part.

    whole: a potential, or a constraint.
    num_slow, num_fast: numbers of slow and of fast variables that `whole` gets as zeros besides the variables of the part; None for no argument.
    """

    whole: Callable | Rheonomic
    num_slow: int | None = None
    num_fast: int | None = None

    def __call__(self, *arguments):
        q, params = arguments[-2:]
        slow, fast = ([] if number is None else [jnp.zeros(number)] for number in (self.num_slow, self.num_fast))
        # the first argument of a constraint is the time
        function, arguments = with_time(self.whole, arguments[0], *slow, q, *fast, params)
        return function(*arguments)


def slow_part(
    system: System, scheme: Scheme, potential: Callable | None, further: Sequence[PlacedPotential], num_fast: int
) -> tuple[System, Scheme]:
    """The system of the slow variables, and the scheme of their step over the macro interval.

    Args:
        system, scheme: of the whole system.
        potential: V; None if it only kicks.
        further: further potentials of slow variables alone, with nodes inside the macro interval.
        num_fast: number of fast variables of the whole system.
    """
    alone = System(
        ConstantMass(jnp.zeros(0), constant_mass(system).slow),
        fast_potential=None if potential is None else OfPart(potential, num_fast=num_fast),
        constraint=None if system.slow_constraint is None else Rheonomic(OfPart(system.slow_constraint)),
        params=system.params,
        potentials={item.name: OfPart(item.function, num_fast=num_fast) for item in further},
    )
    return alone, _single(PlacedRule(scheme.slow.rule, scheme.slow.grid), further)


def fast_part(
    system: System, scheme: Scheme, potential: Callable | None, further: Sequence[PlacedPotential], num_slow: int
) -> tuple[System, Scheme]:
    """The system of the fast variables, and the scheme of a step of k micro intervals.

    Args:
        system, scheme: of the whole system.
        potential: W; None if its rule does not span k micro intervals.
        further: further potentials of fast variables alone whose rules span k micro intervals.
        num_slow: number of slow variables of the whole system.
    """
    alone = System(
        ConstantMass(jnp.zeros(0), constant_mass(system).fast),
        fast_potential=potential,
        constraint=None if system.constraint is None else Rheonomic(OfPart(system.constraint, num_slow)),
        params=system.params,
        potentials={item.name: OfPart(item.function, num_slow) for item in further},
    )
    return alone, _single(replace(scheme.fast, every=1), further)


@dataclass(frozen=True)
class AtRest:
    """W, or g with the slow variables at rest, as a function with the parameters ``(params, q_s)``."""

    whole: Callable
    sees_slow: bool

    def __call__(self, *arguments):
        q, (params, q_s) = arguments[-2:]
        slow = [q_s] if self.sees_slow else []
        return self.whole(*slow, q, params)


def frozen_slow(system: System, scheme: Scheme, q_s) -> tuple[System, Scheme]:
    """The system of the fast variables under W and g with the slow variables at rest in q_s, and the scheme of one micro interval."""
    alone = System(
        ConstantMass(jnp.zeros(0), constant_mass(system).fast),
        fast_potential=None if system.fast_potential is None else AtRest(system.fast_potential, sees_slow=False),
        constraint=None if system.constraint is None else AtRest(system.constraint, sees_slow=True),  # pyright: ignore[reportArgumentType]
        params=(system.params, q_s),
    )
    rule = micro(scheme.kinetic.rule)
    return alone, Scheme(1, scheme.degree, kinetic=rule, slow=rule, fast=scheme.fast)


def _single(fast: PlacedRule, further: Sequence[PlacedPotential]) -> Scheme:
    """A scheme of fast variables alone on one interval."""
    drift = micro(midpoint)
    potentials = {item.name: micro(item.placed.rule) for item in further}
    return Scheme(1, kinetic=drift, slow=drift, fast=fast, potentials=potentials)

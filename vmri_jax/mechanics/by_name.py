"""Configurations as dictionaries of arrays: functions of the user get ``q_f["load"]``, all other code has one flat
vector.

`Slots` give the place of every array in the flat vector. `vmri_jax.Problem` knows them, and `flat_system` wraps every
function of its system once: the function gets dictionaries, and forces and constraint rows that it returns as
dictionaries become vectors. No code behind the problem handles dictionaries.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from vmri_jax.mechanics.functions import TracedOnce, in_order
from vmri_jax.mechanics.masses import ConstantMass
from vmri_jax.mechanics.slots import Slots
from vmri_jax.mechanics.system import System
from vmri_jax.mechanics.terms import Term
from vmri_jax.refusals import Refused


@dataclass(frozen=True)
class ByName:
    """A function of dictionaries as a function of flat vectors; two of these are equal if their functions and slots
    are.

    Args:
        function: of the user.
        arguments: names of its arguments, in order.
        slow, fast: slots of q_s, v_s and of q_f, v_f; None for vectors.
    """

    function: Callable
    arguments: tuple[str, ...]
    slow: Slots | None
    fast: Slots | None

    def __call__(self, *arguments):
        value = self.by_name(*arguments)
        if isinstance(value, Mapping):  # rows of constraints
            return jnp.concatenate([jnp.reshape(rows, (-1,)) for rows in value.values()] or [jnp.zeros(0)])
        if not isinstance(value, tuple):
            return value
        parts = zip(("F_s", "F_f"), value, (self.slow, self.fast), strict=False)
        return tuple(
            slots.flat(f"System: force: {name}", part, zeros=True) if slots and isinstance(part, Mapping) else part
            for name, part, slots in parts
        )

    def by_name(self, *arguments):
        """The value of the user's function, with dictionaries as the user returns them."""
        slots = {"q_s": self.slow, "v_s": self.slow, "q_f": self.fast, "v_f": self.fast}
        shaped = zip(map(slots.get, self.arguments), arguments, strict=True)
        try:
            return self.function(*(value if part is None else part.by_name(value) for part, value in shaped))
        except KeyError as error:
            parts = {"q_s": self.slow, "q_f": self.fast, "params": arguments[-1]}
            named = {name: getattr(part, "sizes", part) for name, part in parts.items()}
            names = [f"{k} has {', '.join(map(str, v)) or 'none'}" for k, v in named.items() if isinstance(v, Mapping)]
            raise KeyError(f"{error.args[0]!r} is not there; {' and '.join(names)}") from error


def flat_system(system: System, slow: Slots | None, fast: Slots | None) -> System:
    """The same system as functions of flat vectors.

    Args:
        system: with functions of dictionaries, wrapped or not.
        slow, fast: slots of q_s and q_f; None for vectors.

    Raises:
        ValueError: masses of bodies that are not in the slots.
    """

    def flat(term: Term):
        function = term.function
        if isinstance(function, ConstantMass):
            return ConstantMass(_flat_mass("slow", function.slow, slow), _flat_mass("fast", function.fast, fast))
        if isinstance(function.function, ByName):
            return function
        return TracedOnce(ByName(function.function, (*term.arguments, "params"), slow, fast), order=function.order)

    return system.mapped(flat)


def constraint_sizes(function: Any, *arguments) -> dict[str, int]:
    """Names and numbers of rows of a constraint that returns its rows by name; empty for other constraints."""
    sizes: dict[str, int] = {}

    def note_sizes(*arguments):
        *others, params = arguments
        value = function.function.by_name(*others, in_order(params, function.order))
        sizes.update({name: jnp.size(rows) for name, rows in value.items()} if isinstance(value, Mapping) else {})
        return ()

    if isinstance(getattr(function, "function", None), ByName):
        jax.eval_shape(note_sizes, *arguments)
    return sizes


def _flat_mass(name: str, mass, slots: Slots | None):
    if not isinstance(mass, Mapping):
        return mass
    if slots is None:
        raise Refused(
            f"ConstantMass: {name} has masses by name, {', '.join(mass)}, but the {name} coordinates are a vector; "
            "give both as dictionaries, or both as arrays."
        )
    return slots.flat(f"ConstantMass: {name}", mass, per_row=True)

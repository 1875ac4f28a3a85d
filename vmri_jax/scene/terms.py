"""Terms: effects at their places in q_s and q_f, and the functions of a `System` as sums of terms.

Everything here is compared by value: scenes of the same structure give equal functions, and nothing is compiled twice.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add
from typing import Any

import jax
import jax.numpy as jnp

from vmri_jax.scene.layout import Rows

MASS = "mass"
"""Where the masses are in params if the kinetic energy is a function."""


@dataclass(frozen=True)
class EffectTerm:
    """The function of an effect on the elements `select` (None: all of them), whose roles lie at `roles`.

    `split` names the parameters that have an entry for each element. The function of a `timed` one has the time before its
    other arguments.
    """

    name: str
    function: Callable
    roles: tuple[Rows, ...]
    select: tuple[int, ...] | None = None
    split: tuple[str, ...] = ()
    timed: bool = False

    def params_of(self, params):
        """What the function gets as params."""
        return params[self.name] if self.select is None else choose(params[self.name], self.select, self.split)

    def take(self, q_s, q_f):
        """The coordinates of every role."""
        return tuple(rows.take(q_s, q_f) for rows in self.roles)

    def value(self, q_s, q_f, params, t=None):
        """Energy or constraint values."""
        return self.function(*((t,) if self.timed else ()), self.take(q_s, q_f), self.params_of(params))

    def kinetic(self, q_s, q_f, v_s, v_f, params):
        """Velocity-dependent energy."""
        return self.function(self.take(q_s, q_f), self.take(v_s, v_f), self.params_of(params))

    def forces(self, t, q_s, q_f, v_s, v_f, params):
        """Force on all slow and on all fast coordinates."""
        forces = self.function(t, self.take(q_s, q_f), self.take(v_s, v_f), self.params_of(params))
        sizes = q_s.shape[0], q_f.shape[0]
        return totals([rows.put(force, *sizes) for rows, force in zip(self.roles, forces, strict=True)])


@dataclass(frozen=True)
class TangentDamping:
    """``F = -beta K v``, K the Hessian of the energy of some terms."""

    name: str
    terms: tuple[EffectTerm, ...]

    def forces(self, t, q_s, q_f, v_s, v_f, params):
        """Force on all slow and on all fast coordinates."""

        def energy(q):
            q_s, q_f = q
            return total([term.value(q_s, q_f, params) for term in self.terms])

        rates = jax.jvp(jax.grad(energy), ((q_s, q_f),), ((v_s, v_f),))[1]
        return tuple(-params[self.name]["stiffness"] * rate for rate in rates)


def choose(params, select: Sequence[int], split: Sequence[str]):
    """Parameters of some elements: entries of those in `split` that have one for each element."""
    return params | {name: pick(params[name], select) for name in split if name in params and jnp.ndim(params[name])}


def pick(values, select: Sequence[int]):
    """Entries of an array by static slices; a single one without its axis."""
    if len(select) == 1:
        return values[select[0]]
    if list(select) == list(range(select[0], select[0] + len(select))):
        return values[select[0] : select[0] + len(select)]
    return jnp.stack([values[i] for i in select])


def total(values: Sequence):
    """Sum of one or more arrays."""
    return reduce(add, values)


def totals(pairs: Sequence):
    """Sums of the first and of the second ones of pairs (slow, fast)."""
    return tuple(total(parts) for parts in zip(*pairs, strict=True))


def joined(values: Sequence):
    """One vector of arrays of any shape."""
    return jnp.concatenate([jnp.ravel(value) for value in values])


@dataclass(frozen=True)
class _OfTerms:
    """A function of a `System` that is made of terms; compared by class and terms."""

    terms: tuple[Any, ...]


class SlowPotential(_OfTerms):
    """``V(q_s, q_f, params)``, the sum of its terms."""

    def __call__(self, q_s, q_f, params):
        return total([term.value(q_s, q_f, params) for term in self.terms])


class FastPotential(_OfTerms):
    """``W(q_f, params)``, the sum of its terms."""

    def __call__(self, q_f, params):
        return total([term.value(None, q_f, params) for term in self.terms])


class MicroConstraint(_OfTerms):
    """``g(q_s, q_f, params)``, or ``g(t, q_s, q_f, params)``: the values of its terms one after the other."""

    def __call__(self, *arguments):
        *t, q_s, q_f, params = arguments
        return joined([term.value(q_s, q_f, params, *t) for term in self.terms])


class MacroConstraint(_OfTerms):
    """``g_s(q_s, params)``, or ``g_s(t, q_s, params)``: the values of its terms one after the other."""

    def __call__(self, *arguments):
        *t, q_s, params = arguments
        return joined([term.value(q_s, None, params, *t) for term in self.terms])


class KineticEnergy(_OfTerms):
    """``T = sum m v^2 / 2`` and the velocity-dependent terms."""

    def __call__(self, q_s, q_f, v_s, v_f, params):
        mass = params[MASS]
        constant = (jnp.sum(mass["slow"] * v_s**2) + jnp.sum(mass["fast"] * v_f**2)) / 2
        return total([constant, *(term.kinetic(q_s, q_f, v_s, v_f, params) for term in self.terms)])


class TotalForce(_OfTerms):
    """``F(t, q_s, q_f, v_s, v_f, params)``, the sum of its terms."""

    def __call__(self, t, q_s, q_f, v_s, v_f, params):
        return totals([term.forces(t, q_s, q_f, v_s, v_f, params) for term in self.terms])


FUNCTIONS = {
    "kinetic": KineticEnergy,
    "slow_potential": SlowPotential,
    "fast_potential": FastPotential,
    "constraint": MicroConstraint,
    "slow_constraint": MacroConstraint,
    "force": TotalForce,
}
"""What is made of the terms of a home."""

"""The physics of a system: plain JAX functions of slow and fast variables, written by the user."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.functions import NO_TIME, NO_VELOCITY, Order, Rheonomic, check_arguments, order_of
from vmri_jax.mechanics.masses import ConstantMass
from vmri_jax.mechanics.slots import check_computed
from vmri_jax.mechanics.summary import numbers, parameters, summary
from vmri_jax.mechanics.surroundings import name_of
from vmri_jax.mechanics.terms import KINDS, Named, Term, label
from vmri_jax.refusals import Refused

RESERVED = ("kinetic", "path", "order", "solves", *(kind.symbol for kind in KINDS.values() if kind.symbol))
"""Names that potentials in `System.potentials` must not have: symbols of other terms, and names of rows in the
description of a scheme."""
RATE_OF: dict[str | int, str] = {"V": "slow", "W": "fast"}
"""The rates of V and W: a potential of this name in `System.potentials` has the same rule."""
FAST_ALONE = (
    "It sees fast variables alone: whatever a stiff spring joins is fast, also a heavy body, and stands in q_f. Or "
    "give the function as potentials={{'fast': W}}, which may join slow and fast variables on the micro grid."
)
"""Advice for a fast potential that takes slow variables."""
_INSTEAD = {
    "force": "force(t, q_s, q_f, v_s, v_f, params) -> (F_s, F_f)",
    "moving": "Rheonomic(function), whose function gets t first",
}


def _argument(field: str) -> Any:
    """The property with the function of this argument of `System`; None without a function."""

    def function(system: "System"):
        term = next((term for term in system.terms if term.field == field), None)
        return term and (Rheonomic(term.function) if term.moves else term.function)

    return property(function)


class System(eqx.Module):
    """Mechanical system with Lagrangian ``L = T - V - W - sum_i V_i``, constraints ``g = 0`` and forces ``F``.

    Args:
        kinetic: `ConstantMass`, or ``kinetic(q_s, q_f, v_s, v_f, params) -> ()``, regular in the velocities.
        slow_potential: ``V(q_s, q_f, params) -> ()``.
        fast_potential: ``W(q_f, params) -> ()``.
        constraint: ``g(q_s, q_f, params) -> (n_g,)``, holonomic, involving fast variables.
        slow_constraint: ``g_s(q_s, params) -> (n_gs,)``, holonomic, of slow variables alone. Constraints that depend on
            time are given as `Rheonomic` functions.
        force: ``F(t, q_s, q_f, v_s, v_f, params) -> (F_s, F_f)``, not derived from a potential.
        params: any pytree of arrays, handed to every function; traced, so that sweeps and gradients over it never
            recompile. Dictionaries reach functions in the order in which they are written here; other params of the
            same names, in `replace` or of single runs, are put into this order. JAX sorts the names of a dictionary
            that is an argument of a function in jit, grad or vmap: make the system outside of it, and `replace` its
            params inside.
        implied: ``g_i(q_s, q_f, params) -> (n_i,)``, redundant rows that follow from the constraints, scaled to order
            one; or a `Rheonomic` function. Steps do not solve for them, and they have no multipliers. A run checks them
            at its saved nodes: they count in `constraint_residual`, and if one of them is not zero the run ends as
            `NOT_IMPLIED`.
        slow_kinetic: ``T_s(q_s, v_s, params) -> ()``, the part of the kinetic energy that depends on slow variables
            alone, besides the function `kinetic`. Schemes evaluate it on the macro grid, see
            `vmri_jax.schemes.discrete_lagrangian`.
        potentials: further potentials ``V_i(q_s, q_f, params) -> ()`` by name, each with a rate of its own: a scheme
            has a rule for each name, see `vmri_jax.Scheme.with_potentials`. The names "slow" and "fast" have the rules
            of V and of W unless the scheme says otherwise, so that ``{"fast": V_1}`` is a potential on the micro grid
            that may join slow and fast variables. The name k, a whole number, has the trapezoidal rule on every k-th
            micro node.

    A run uses what its functions read from around them when it is made: globals, helpers, closures, attributes, see
    `vmri_jax.mechanics.surroundings`. Functions with the same code and surroundings are the same; for others everything
    is compiled again, so that what varies belongs in `params`. A system stores its `terms`, and shows the arguments
    above as attributes. Functions are kept as `TracedOnce`, so that ``system.force`` is called like the function
    itself, which is the innermost ``function`` of it.
    """

    terms: tuple[Term, ...]
    params: Any

    def __init__(
        self,
        kinetic,
        slow_potential=None,
        fast_potential=None,
        constraint=None,
        slow_constraint=None,
        force=None,
        *,
        params=None,
        implied=None,
        slow_kinetic=None,
        potentials=None,
    ):
        given, order, terms = locals(), order_of(params), []
        if isinstance(kinetic, ConstantMass) and slow_kinetic is not None:
            raise Refused(
                "System: slow_kinetic is given besides a ConstantMass, which has the masses of all slow variables; "
                "give the whole kinetic energy as ConstantMass, or kinetic as a function."
            )
        if not callable(kinetic):
            raise Refused(
                f"System: kinetic is {kinetic!r}; give ConstantMass(slow, fast) or a function kinetic(q_s, q_f, v_s, "
                "v_f, params)."
            )
        for field, kind in reversed(KINDS.items()):  # kinetic last: of swapped arguments the other one tells more
            if field == "potentials":
                terms[:0] = [_checked(field, name, V, order) for name, V in _named(potentials or ()).items()]
            elif given[field] is not None:
                terms.insert(0, _checked(field, kind.symbol, given[field], order))
        self.terms, self.params = tuple(terms), params

    kinetic = _argument("kinetic")
    slow_kinetic = _argument("slow_kinetic")
    slow_potential = _argument("slow_potential")
    fast_potential = _argument("fast_potential")
    constraint = _argument("constraint")
    slow_constraint = _argument("slow_constraint")
    force = _argument("force")
    implied = _argument("implied")

    @property
    def potentials(self) -> Named[Any]:
        """The further potentials by name."""
        return Named({term.name: term.function for term in self.terms if term.field == "potentials"})

    def __repr__(self) -> str:
        return summary("System", self.in_words())

    def of_kind(self, kind: str) -> tuple[Term, ...]:
        """The terms of a kind, of `vmri_jax.mechanics.terms`."""
        return tuple(term for term in self.terms if term.kind == kind)

    def only(self, keep: Callable[[Term], bool]) -> "System":
        """The system with its kinetic energy, and with the other terms for which `keep` is true."""
        return _changed(self, terms=tuple(term for term in self.terms if term.kind == "kinetic" or keep(term)))

    def mapped(self, changed: Callable[[Term], Any]) -> "System":
        """The system whose functions are those that `changed` returns for its terms, each in place of its function;
        None for no function. They are not checked."""
        order, pairs = order_of(self.params), ((term, changed(term)) for term in self.terms)
        return _changed(self, terms=tuple(term.with_function(f, order) for term, f in pairs if f is not None))

    def in_words(self) -> dict[str, str]:
        """The terms and the params in words, for summaries."""
        words = {}
        for term in self.terms:
            mass, moves = term.function, ", which depends on time" if term.moves else ""
            is_function = not isinstance(mass, ConstantMass)
            masses = "" if is_function else f"masses, slow {numbers(mass.slow)}; fast {numbers(mass.fast)}"
            words[f"{KINDS[term.field].in_words} {term.label}"] = masses or f"function {name_of(term.function)}{moves}"
        return {**words, "params": parameters(self.params)}

    def replace(self, **changes) -> "System":
        """The same system with some fields changed, e.g. ``system.replace(params=new)``.

        Raises:
            ValueError: changed numbers that a scene computes, see `with_params`.
        """
        check_computed(self.params, changes.get("params"))
        return System(**{name: getattr(self, name) for name in (*KINDS, "params")} | changes)

    def with_params(self, params) -> "System":
        """The same system with other parameters, without the checks of the constructor, which take a millisecond.

        Raises:
            ValueError: changed numbers that a scene computes from its bodies and has other copies of, such as
                ``gravity.mass``.
        """
        check_computed(self.params, params)
        return _changed(self, params=params)

    def all_potentials(self, q_s, q_f) -> dict:
        """Values of V ("slow"), of W ("fast") and of `potentials` by name; zero without V or W. A potential named
        "slow" or "fast" is added."""
        values: dict[str | int, Any] = {"slow": jnp.zeros(()), "fast": jnp.zeros(())}
        for term in self.of_kind("potential"):
            name = RATE_OF.get(term.name, term.name)
            values[name] = values.get(name, 0.0) + term(self.params, q_s=q_s, q_f=q_f)
        return values

    def kinetic_energy(self, q_s, q_f, v_s, v_f):
        """``T + T_s``."""
        T, *others = (term(self.params, q_s=q_s, q_f=q_f, v_s=v_s, v_f=v_f) for term in self.of_kind("kinetic"))
        return sum(others, T)

    def g(self, t, q_s, q_f):
        """Values of `constraint`, shape (n_g,); n_g = 0 without a constraint."""
        return self._rows("constraint", t=t, q_s=q_s, q_f=q_f)

    def g_slow(self, t, q_s):
        """Values of `slow_constraint`, shape (n_gs,); n_gs = 0 without a slow constraint."""
        return self._rows("slow_constraint", t=t, q_s=q_s)

    def g_implied(self, t, q_s, q_f):
        """Values of `implied`, shape (n_i,); n_i = 0 without implied rows."""
        return self._rows("implied", t=t, q_s=q_s, q_f=q_f)

    def _rows(self, field: str, **values):
        return next((term(self.params, **values) for term in self.terms if term.field == field), jnp.zeros(0))

    @property
    def has_constant_mass(self) -> bool:
        """Whether the kinetic energy is a `ConstantMass`."""
        return isinstance(self.kinetic, ConstantMass)

    @property
    def is_constrained(self) -> bool:
        """Whether there are constraints."""
        return any(term.kind == "constraint" for term in self.terms)

    @property
    def is_rheonomic(self) -> bool:
        """Whether constraints depend on time."""
        return any(term.kind == "constraint" and term.moves for term in self.terms)

    @property
    def keeps_energy(self) -> bool:
        """Whether the energy is conserved: no `force`, and no constraint that depends on time."""
        return self.force is None and not self.is_rheonomic

    def forces(self, t, q_s, q_f, v_s, v_f):
        """Values of `force`, ``(F_s, F_f)``; zero without a force."""
        if self.force is None:
            return jnp.zeros_like(q_s), jnp.zeros_like(q_f)
        return self.force(t, q_s, q_f, v_s, v_f, self.params)

    def constraints(self, t, q_s, q_f):
        """All constraint values at one configuration, ``(g, g_slow)`` joined, shape (n_g + n_gs,)."""
        return jnp.concatenate([self.g(t, q_s, q_f), self.g_slow(t, q_s)])

    def constraint_rates(self, t, q_s, q_f, v_s, v_f):
        """Rates of all constraint values, ``G v + dg/dt``, shape (n_g + n_gs,)."""
        return jax.jvp(self.constraints, (t, q_s, q_f), (jnp.ones_like(t), v_s, v_f))[1]

    def num_constraints(self, q_s, q_f) -> tuple[int, int]:
        """``(n_g, n_gs)`` for configurations of these shapes."""
        t = np.zeros(())
        return jax.eval_shape(self.g, t, q_s, q_f).shape[0], jax.eval_shape(self.g_slow, t, q_s).shape[0]


def _changed(system: System, **changes) -> System:
    """The same system with another tuple of terms, or with other params, without checks. No method: Equinox takes
    tens of microseconds to call one."""
    other = object.__new__(System)
    vars(other).update(vars(system) | changes)
    return other


def _checked(field: str, name: str | int, function: Any, order: Order | None) -> Term:
    """The term of an argument of `System`, after checks; `order` is of the params."""
    term = Term(field, name, KINDS[field].arguments, function)
    holds = term.kind in ("constraint", "implied")
    if isinstance(function, Rheonomic) and holds:
        term = Term(field, name, ("t", *term.arguments), function.function)
    inner = term.function
    place = f"System: {term.place}"
    if isinstance(inner, ConstantMass):
        if field == "kinetic":
            return term
        raise Refused(f"{place} is a ConstantMass; masses come first, System(ConstantMass(slow, fast), V, W).")
    if not callable(inner):
        raise Refused(f"{place} is {function!r}; it must be a function{' or None' * (field != 'potentials')}.")
    try:
        hash(inner)
    except TypeError:
        raise Refused(
            f"{place} is {inner!r}, which has no hash: programs are compiled once per function. Give a plain function, "
            "with what varies in params."
        ) from None
    instead = "" if field == "force" else NO_VELOCITY if holds else NO_TIME
    if field == "fast_potential" and "q_s" in getattr(getattr(inner, "__code__", None), "co_varnames", ()):
        instead = FAST_ALONE
    check_arguments(place, inner, ", ".join((*term.arguments, "params")), instead.format(**_INSTEAD))
    return term.with_function(inner, order)


def _named(potentials) -> dict:
    """Functions by name, from a mapping or from pairs, after checks of the names."""
    try:
        named = dict(potentials)
    except (TypeError, ValueError):
        raise Refused(
            f"System: potentials is {potentials!r}; give functions by name, e.g. potentials={{'bends': V_1, 'bonds': "
            "V_2}."
        ) from None
    for name in named:
        if isinstance(name, bool) or not isinstance(name, str | int) or (isinstance(name, int) and name < 1):
            raise Refused(
                f"System: potentials has the name {name!r}; give a text, or a whole number k of at least 1 for a "
                "potential on every k-th micro node."
            )
        if name in RESERVED or [label(other) for other in named].count(label(name)) > 1:
            raise Refused(
                f"System: potentials has the name {name!r}, which is the name of another term: one of "
                f"{', '.join(RESERVED)}, or V_k of the potential k. Take another name."
            )
    return named

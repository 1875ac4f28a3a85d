"""The discrete Lagrangian: a weighted sum of the user's functions at quadrature nodes of the path.

    L_d(S, F) = sum over terms, over nodes i of the term's rule:  H w_i term(q(theta_i), qdot(theta_i))

`lagrangian` builds the sum ``T - V - W - sum_i V_i``, with every term on the nodes of its rule.

The part ``T_s(q_s, q_s')`` of the kinetic energy that depends on slow variables alone, `System.slow_kinetic`, has the
rule of T on the macro grid, just as g_s has the rule of g:

    sum_i H w_i T_s(S(c_i H), S'(c_i H))        in place of        sum_m sum_i h w_i T_s at the nodes (m + c_i) h

S is one polynomial over the macro interval, so that both sums have the order of the rule, and both are discrete
Lagrangians, whose steps are symplectic and keep momentum maps. The sums are equal if T_s has constant masses (as for
rigid bodies in director coordinates) and the rule is exact for the square of S'. Else they differ by the error of the
rule, of the order of the scheme. The cost of the left sum does not grow with the number of micro steps.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp

from vmri_jax.kernels import matmul
from vmri_jax.mechanics.system import ConstantMass, System
from vmri_jax.mechanics.terms import POSITIONS, Term
from vmri_jax.refusals import Refused
from vmri_jax.schemes.path import Nodes, lagrange_derivative, position_nodes, velocity_nodes
from vmri_jax.schemes.quadrature import PlacedRule
from vmri_jax.schemes.scheme import Scheme


@dataclass(frozen=True)
class TermOnNodes:
    """An integrand on its nodes: ``H^(1 + power) sum_i w_i integrand(path at theta_i)``.

    integrand, arguments: function of the path, and the names of its arguments, e.g. ``("q_s", "q_f")``.
    inside: nodes inside the macro interval.
    start, end: weights at the ends of the macro interval, for terms without velocities; None without such a node. These
        nodes are kicks.
    sign: of the term in the Lagrangian.
    grid: of its rule, see `PlacedRule`.
    mollified: whether kicks take averaged fast positions.
    power: further powers of H in front of the sum, for corrections.
    name: for texts.
    """

    integrand: Callable
    arguments: tuple[str, ...]
    inside: Nodes
    start: Any = None
    end: Any = None
    sign: float = 1.0
    grid: str = "micro"
    mollified: bool = False
    power: int = 0
    name: str = ""

    def times_step(self, macro_dt):
        """The factor ``H^(1 + power)`` of the weights."""
        return macro_dt ** (1 + self.power)

    def at(self, q_s, q_f):
        """The integrand at one configuration, of a term without velocities."""
        q = dict(zip(POSITIONS, (q_s, q_f), strict=True))
        return self.integrand(*(q[name] for name in self.arguments))

    def gradient(self, q_s, q_f):
        """``(d/dq_s, d/dq_f)`` of the signed integrand at one configuration, for kicks."""
        by_position = zip(POSITIONS, jax.grad(self.at, argnums=(0, 1))(q_s, q_f), strict=True)
        # the derivative by an argument that the term does not have stays 0: XLA would add a -0
        return tuple(self.sign * d if name in self.arguments else d for name, d in by_position)


@dataclass(frozen=True)
class QuadraticKinetic:
    """Kinetic energy of constant masses: a quadratic form in the increments Delta, assembled once.

        sum_ij k_ij Delta_i^T M Delta_j / (2 T),        k_ij = sum_n w_n l_i'(c_n) l_j'(c_n)

    for the slow increments over the macro interval, T = H, and for the fast increments over each micro interval, T = h;
    the weights w_n sum to 1 over the interval.
    """

    mass: ConstantMass
    nodes: Nodes

    @property
    def slow_form(self):
        """(r + 1, r + 1) matrix k of the macro interval."""
        return self._form(self.nodes.theta, self.nodes.weights)

    @property
    def fast_form(self):
        """(r + 1, r + 1) matrix k of a micro interval."""
        first = self.nodes.interval == 0
        return self._form(self.nodes.c[first], self.nodes.num_micro * self.nodes.weights[first])

    def _form(self, theta, weights):
        slopes = lagrange_derivative(self.nodes.degree, theta)
        return jnp.sum(weights[:, None, None] * (slopes[:, :, None] * slopes[:, None, :]), axis=0)

    def slow_rows(self, slow):
        """The derivatives ``sum_j k_ij M Delta_j`` by the slow increments (r, n_s), times H."""
        return matmul(self.slow_form[1:, 1:], self.mass.slow_mass.times(slow))

    def fast_rows(self, fast):
        """The derivatives ``sum_j k_ij M Delta_j`` by the fast increments (..., r, n_f), times h."""
        return matmul(self.fast_form[1:, 1:], self.mass.fast_mass.times(fast))


@dataclass(frozen=True)
class Lagrangian:
    """A sum of terms, and the `QuadraticKinetic` of constant masses; None for a kinetic energy that is a function, and
    then among the terms."""

    kinetic: Any
    terms: tuple[TermOnNodes, ...]

    @property
    def kicks(self) -> tuple[TermOnNodes, ...]:
        """The terms that have nodes at the ends of the macro interval."""
        return tuple(term for term in self.terms if term.start is not None or term.end is not None)


class PlacedTerm(NamedTuple):
    """A term of a system with the rule that a scheme gives it."""

    term: Term
    rule: PlacedRule


def placed_potentials(system: System, scheme: Scheme) -> tuple[PlacedTerm, ...]:
    """All potentials of a system with the rules that a scheme gives them.

    Raises:
        ValueError: a potential without a rule.
    """
    return tuple(PlacedTerm(term, scheme.rule_of(term.name)) for term in system.of_kind("potential"))


def lagrangian(system: System, scheme: Scheme) -> Lagrangian:
    """``T - V - W - sum_i V_i`` of a system, each term on the nodes the scheme gives it."""
    potentials = [
        _on_position_nodes(term.function, term.arguments, rule, scheme, system, term.label, sign=-1.0)
        for term, rule in placed_potentials(system, scheme)
    ]
    nodes = velocity_nodes(scheme.kinetic, scheme.num_micro, scheme.degree)
    masses = QuadraticKinetic(system.kinetic, nodes) if system.has_constant_mass else None
    kinetic = [] if system.has_constant_mass else _kinetic_functions(system, scheme, nodes)
    return Lagrangian(masses, (*kinetic, *potentials, *_corrections(system, scheme)))


def _corrections(system: System, scheme: Scheme) -> list[TermOnNodes]:
    """The corrections by squared gradients of `vmri_jax.schemes.quadrature.gradient_corrected`.

        h^2/24 grad W . M^-1 grad W        H^2/24 grad V . M^-1 grad V + h^2/12 grad V . M^-1 grad W

    as terms of the Lagrangian, with the factor H^2 in `TermOnNodes.power` and h = H / num_micro.
    """
    if not scheme.slow.gradient_corrected and not scheme.fast.gradient_corrected:
        return []
    if not system.has_constant_mass:
        raise Refused("Scheme: corrected kicks need a System whose kinetic is a ConstantMass.")
    mass, potentials = system.kinetic, (system.slow_potential, system.fast_potential)
    slow_potential, fast_potential = cast(tuple[Callable, Callable], potentials)
    both = scheme.fast.gradient_corrected and fast_potential is not None

    def fast(q_f, params):
        d = jax.grad(fast_potential)(q_f, params)
        return jnp.sum(d * mass.velocity(jnp.zeros(mass.slow.shape[-1]), d)[1]) / (24 * scheme.num_micro**2)

    def slow(q_s, q_f, params):
        d = jax.grad(slow_potential, (0, 1))(q_s, q_f, params)
        v_s, v_f = mass.velocity(*d)
        total = (jnp.sum(d[0] * v_s) + jnp.sum(d[1] * v_f)) / 24
        if both:
            total += jnp.sum(v_f * jax.grad(fast_potential)(q_f, params)) / (12 * scheme.num_micro**2)
        return total

    corrections = []
    if scheme.slow.gradient_corrected and slow_potential is not None:
        corrections.append((slow, ("q_s", "q_f"), scheme.slow, scheme, system, "the correction of V"))
    if both:
        corrections.append((fast, ("q_f",), scheme.fast, scheme, system, "the correction of W"))
    return [_on_position_nodes(*correction, power=2) for correction in corrections]


def _kinetic_functions(system, scheme, nodes: Nodes) -> list[TermOnNodes]:
    both, slow = system.kinetic, system.slow_kinetic
    terms = [TermOnNodes(lambda *z: both(*z, system.params), ("q_s", "q_f", "v_s", "v_f"), nodes)]
    if slow is not None:
        nodes = velocity_nodes(scheme.kinetic, 1, scheme.degree)  # the macro interval as one micro interval
        terms.append(TermOnNodes(lambda *z: slow(*z, system.params), ("q_s", "v_s"), nodes, grid="macro"))
    return terms


def _on_position_nodes(function, arguments, placed, scheme, system, name: str, **fields) -> TermOnNodes:
    start, inside, end = position_nodes(placed, scheme.num_micro, scheme.degree)
    fields |= {"grid": placed.grid, "mollified": placed.mollified, "name": name}
    return TermOnNodes(lambda *q: function(*q, system.params), arguments, inside, start, end, **fields)

"""Schemes: which quadrature rule carries which term of the Lagrangian.

A scheme is data. The reference schemes and the Galerkin family are points in one space:

| scheme | V | W | explicit | order |
|---|---|---|---|---|
| `fully_implicit(num_micro)` | micro(midpoint) | micro(midpoint) | no | 2 |
| `explicit_slow(num_micro, alpha)` | macro(affine(alpha)) | micro(midpoint) | in V | 2 if alpha = 1/2 |
| `mollified_impulse(num_micro, alpha)` | mollified(macro(affine(alpha))) | micro(midpoint) | in V | 2 if alpha = 1/2 |
| `fully_explicit(num_micro, alpha)` | macro(affine(alpha)) | micro(affine(alpha)) | yes | 2 if alpha = 1/2 |
| `takahashi_imada(num_micro)` | trapezoidal, corrected | trapezoidal, corrected | yes | 2, 4 in frequencies |
| `galerkin(num_micro, degree, rule)` | micro(rule) | micro(rule) | no | min(2 degree, rule order) |

Corrected rules are ``gradient_corrected(macro(trapezoidal))`` and ``gradient_corrected(micro(trapezoidal))``.

**alpha** is the part of a kick at the start of an interval of length T; the part 1 - alpha acts at its end. It is the
weight of the rule `vmri_jax.schemes.quadrature.affine`, ``T (alpha f(0) + (1 - alpha) f(T))``. The default 1/2 gives
the trapezoidal rule: order 2 and symmetric, as in the methods of Verlet and r-RESPA. 1 and 0 give one kick, before or
after the motion: the two symplectic Euler methods of order 1, each the adjoint of the other. Any other alpha also has
order 1. alpha may be traced, for sweeps and derivatives.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import equinox as eqx
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete, whole_number
from vmri_jax.mechanics.system import RATE_OF
from vmri_jax.mechanics.terms import Named, label
from vmri_jax.refusals import Refused
from vmri_jax.schemes.description import RULES, Description, printed
from vmri_jax.schemes.path import control_nodes, lagrange_derivative
from vmri_jax.schemes.quadrature import (
    NODE_TOLERANCE,
    PlacedRule,
    Rule,
    affine,
    gauss,
    gradient_corrected,
    lobatto,
    macro,
    micro,
    midpoint,
    mollified,
    trapezoidal,
)

GRIDS = {"slow": "macro", "fast": "micro"}
"""The grids on which kicks of V and W may be corrected."""


class Scheme(eqx.Module):
    """Variational multirate scheme: the degree of the path and the rule of every term.

    Without forces every scheme is symplectic and conserves the momentum maps its discrete Lagrangian inherits. Its
    order is ``min(2 degree, order of the rules of energies and forces)`` (Ober-Bloebaum, Wenger, Gail, Leyendecker
    2024, arXiv:2406.12991), where a rule that spans several micro intervals counts as order 2 at most: the fast path
    has a corner at every micro node, and the nodes of the rule act as kicks. A scheme is symmetric (time-reversible)
    exactly when these rules are.

    Args:
        num_micro: micro intervals per macro interval.
        degree: polynomial degree r of the path, on r + 1 Gauss-Lobatto control points.
        kinetic, slow, fast, force: placed rules (``macro(...)`` or ``micro(...)``) of T, V, W and the forces;
            `kinetic` must be placed with micro, `force` defaults to the rule of `kinetic`.
        constraint: where g holds: micro(rule) whose nodes are the control nodes; default micro(lobatto(degree + 1)).
        slow_constraint: where g_s holds: macro(rule) on the same nodes; default macro(lobatto(degree + 1)). With one
            micro interval the weights of `constraint` count for both.
        potentials: placed rules of `System.potentials` by name (a string or a whole number), see `with_potentials`.

    Raises:
        TypeError: num_micro or degree not an integer, or a rule that was not placed with macro or micro.
        ValueError: num_micro or degree below 1, weights that do not sum to 1, constraint nodes that are not the
            control nodes, or ``micro(rule, every=k)`` where k does not divide num_micro.
    """

    num_micro: int = eqx.field(static=True)
    degree: int = eqx.field(static=True)
    kinetic: PlacedRule
    slow: PlacedRule
    fast: PlacedRule
    constraint: PlacedRule
    slow_constraint: PlacedRule
    force: PlacedRule
    potentials: Named[PlacedRule]

    def __init__(  # Equinox flattens the arguments of a generated one, and potentials may have names of two types
        self,
        num_micro: int,
        degree: int = 1,
        *,
        kinetic: PlacedRule,
        slow: PlacedRule,
        fast: PlacedRule,
        constraint: PlacedRule | None = None,
        slow_constraint: PlacedRule | None = None,
        force: PlacedRule | None = None,
        potentials: Mapping[Any, PlacedRule] | None = None,
    ):
        self.num_micro = whole_number("Scheme: num_micro", num_micro)
        self.degree = whole_number("Scheme: degree", degree)
        at_control_nodes = lobatto(self.degree + 1)
        rules = {
            "kinetic": kinetic,
            "slow": slow,
            "fast": fast,
            "force": kinetic if force is None else force,
            "constraint": micro(at_control_nodes) if constraint is None else constraint,
            "slow_constraint": macro(at_control_nodes) if slow_constraint is None else slow_constraint,
        }
        further = dict(potentials or {})
        for name, placed in [*rules.items(), *further.items()]:
            _check_placed(name, placed)
        for name, placed in rules.items():
            if placed.every > 1 and name not in GRIDS:
                raise Refused(
                    f"Scheme: {name} is placed with every={placed.every}; only potentials can be: slow, fast, and "
                    "those of with_potentials(...). Take micro(rule) or macro(rule)."
                )
            setattr(self, name, _on_grid(name, placed, self.num_micro))
        self.potentials = Named({name: _on_grid(name, placed, self.num_micro) for name, placed in further.items()})
        if self.kinetic.grid != "micro":
            raise Refused(
                "Scheme: the kinetic rule must be placed with micro(...); each micro interval has a velocity."
            )
        _check_kinetic(self.kinetic.rule, self.degree)
        of_fields = [(name, name, placed) for name, placed in rules.items()]
        for field, name, placed in [*of_fields, *(("", name, placed) for name, placed in further.items())]:
            if placed.mollified and (field != "slow" or self.fast.grid != "micro"):
                raise Refused(
                    f"Scheme: {name} is mollified; only kicks of the slow potential can be, along fast motion on the "
                    "micro grid: slow=mollified(macro(...)) with fast=micro(...)."
                )
            if placed.gradient_corrected and (placed.grid != GRIDS.get(field) or self.degree > 1):
                raise Refused(
                    f"Scheme: {name} on the {placed.grid} grid, degree {self.degree}, is corrected; only kicks of V "
                    "and W, of a path of degree 1, can be: slow=gradient_corrected(macro(...)), "
                    "fast=gradient_corrected(micro(...))."
                )
        for name, grid in (("constraint", "micro"), ("slow_constraint", "macro")):
            placed = getattr(self, name)
            nodes, needed = np.array(placed.rule.nodes), control_nodes(self.degree)
            if placed.grid != grid or nodes.shape != needed.shape or np.abs(nodes - needed).max() > NODE_TOLERANCE:
                raise Refused(
                    f"Scheme: {name} must be held at the control nodes {needed.tolist()} of degree {self.degree}; "
                    f"give {grid}(lobatto({self.degree + 1})), got {placed.grid} rule with nodes {nodes.tolist()}."
                )
            if is_concrete(placed) and np.any(np.asarray(placed.rule.weights) == 0):
                raise Refused(f"Scheme: a weight of the {name} rule is zero; its multiplier would be undefined.")

    @property
    def order(self) -> int:
        """Order of convergence, ``min(2 degree, order of the rules of T, all potentials and the forces)``; needs
        concrete weights.

        A rule that spans several micro intervals counts as order 2 at most. Potentials and forces of slow variables
        alone have the full order of their rule; a scheme does not know the variables of potentials and forces.
        """
        return min(2 * self.degree, *(placed.order(self.num_micro) for placed in self._of_energies_and_forces))

    @property
    def is_symmetric(self) -> bool:
        """Whether a step forward and a step back with -H lead back to the start; needs concrete weights."""
        return all(placed.rule.is_symmetric for placed in self._of_energies_and_forces)

    @property
    def _of_energies_and_forces(self) -> list[PlacedRule]:
        return [placed for name, placed in self.rules.items() if name not in ("g", "g_s")]

    @property
    def rules(self) -> dict[str | int, PlacedRule]:
        """The placed rules by the symbols of `vmri_jax.mechanics.terms` and the names of further potentials."""
        return {symbol: getattr(self, name) for symbol, name in RULES.items()} | self.potentials

    @property
    def micro_times(self) -> np.ndarray:
        """(num_micro,) ends of the micro steps in units of the macro step."""
        return np.arange(1, self.num_micro + 1) / self.num_micro

    @property
    def unit(self) -> int:
        """The least common multiple of `every` of all rules: num_micro must be a multiple of it."""
        return math.lcm(*(placed.every for placed in (self.slow, self.fast, *self.potentials.values())))

    def with_num_micro(self, num_micro: int) -> "Scheme":
        """The same rules with another number of micro steps."""
        return replace(self, num_micro=num_micro)

    def with_potentials(self, **rules: PlacedRule) -> "Scheme":
        """The same scheme with rules of `System.potentials` by name, besides those that it has.

            kicks = vm.quadrature.trapezoidal
            vm.fully_explicit(32).with_potentials(bends=vm.micro(kicks, every=8), bonds=vm.micro(kicks))

        A potential with the rule ``micro(trapezoidal, every=k)`` kicks at every k-th micro node. If these potentials
        depend on fast variables alone, and V and W kick, the scheme is r-RESPA with any number of levels (Tuckerman,
        Berne and Martyna, J. Chem. Phys. 97, 1992). A potential that depends on slow variables is implicit in them,
        because the slow path is one polynomial over the macro step. Evaluations per macro step: num_micro / k.

        Args:
            rules: placed rules by name of the potential.

        Raises:
            TypeError: a rule that was not placed with macro or micro.
            ValueError: ``every`` that does not divide num_micro, weights that do not sum to 1.
        """
        return replace(self, potentials=self.potentials | rules)

    def rule_of(self, name: str | int) -> PlacedRule:
        """The rule of a term, by its symbol or the name of a potential in `System.potentials`.

        The names "slow" and "fast" get the rules of V and W, without filter and correction.

        Raises:
            ValueError: a name without a rule; a whole number that does not divide num_micro.
        """
        if name in self.rules:
            return self.rules[name]
        if isinstance(name, int):
            return _on_grid(f"the potential {name}", micro(trapezoidal, every=name), self.num_micro)
        if name in RATE_OF.values():
            placed = getattr(self, name)
            return PlacedRule(placed.rule, placed.grid, every=placed.every)
        raise Refused(
            f"Scheme: there is no rule for the potential {name!r} of the system; the scheme has rules for "
            f"{list(self.potentials) or 'V and W only'}. Give it one, e.g. "
            f"scheme.with_potentials({name}=vm.micro(vm.quadrature.trapezoidal, every=2))."
        )

    def evaluations_of(self, name: str | int) -> int:
        """Number of gradients of a potential in `System.potentials` per macro step; a node that two macro steps share
        counts once.

        Raises:
            ValueError: as of `rule_of`.
        """
        return self.rule_of(name).evaluations(self.num_micro)

    def __repr__(self) -> str:
        return printed(self)

    def describe(self) -> Description:
        """Rules, order, symmetry, evaluations and solves per macro step; prints as a table.

        ``vm.plan(system, scheme, state).describe()`` describes the scheme applied to a system.
        """
        further = self.potentials.values()
        drifts = self.degree == 1 and self.fast.only_ends and self.fast.grid == "micro"
        drifts = drifts and all(placed.only_ends for placed in further)
        kicked = self.degree == 1 and self.slow.only_kicks and all(p.grid == "micro" or p.only_ends for p in further)
        # solves without constraints: none if V and W only kick, one per micro step if V only kicks, else one of all
        # unknowns
        free = 0 if drifts and kicked else self.num_micro if kicked and self.fast.grid == "micro" else 1
        slow, fast = (
            placed.evaluations(self.num_micro) * (1 + placed.gradient_corrected) for placed in (self.slow, self.fast)
        )
        fast *= 1 + self.slow.mollified  # a second time along the motion of the average
        fast += self.slow.gradient_corrected and self.fast.gradient_corrected  # grad V . M^-1 grad W
        rules = {label(name): rule.in_words() for name, rule in self.rules.items()}
        evaluations = {label(name): rule.evaluations(self.num_micro) for name, rule in self.potentials.items()}
        costs = slow, fast, free, 1, evaluations
        return Description(self.order, self.is_symmetric, rules, 1, self.num_micro, self.degree, *costs)


def _on_grid(name: str | int, placed: PlacedRule, num_micro: int) -> PlacedRule:
    """The placed rule, moved to the macro grid if one copy of it spans the macro interval."""
    if placed.every > 1 and num_micro % placed.every:
        divisors = [k for k in range(1, num_micro + 1) if num_micro % k == 0]
        raise Refused(
            f"Scheme: {name} is placed with every={placed.every}, which does not divide num_micro={num_micro}: its "
            f"last copy would end in the next macro step. Take one of {divisors}, or another num_micro."
        )
    return PlacedRule(placed.rule, "macro") if placed.every == num_micro > 1 else placed


def _check_kinetic(rule: Rule, degree: int) -> None:
    """Refuse rules by which a motion of the path has no positive kinetic energy: ``sum_i w_i l_j'(c_i) l_k'(c_i)`` is
    not positive definite."""
    slopes = lagrange_derivative(degree, np.array(rule.nodes))[:, 1:]
    weights = np.asarray(rule.weights) if is_concrete(rule) else np.ones(len(rule.nodes))
    if np.linalg.eigvalsh(slopes.T @ (weights[:, None] * slopes)).min() <= 1e-9:
        raise Refused(
            f"Scheme: the kinetic rule with nodes {list(rule.nodes)} gives no positive kinetic energy to some motion "
            f"of a path of degree {degree}: it has too few nodes, or a negative weight. Give another, e.g. "
            f"micro(gauss({degree}))."
        )


def _check_placed(name: str | int, placed) -> None:
    if isinstance(placed, Rule):
        raise Refused(f"Scheme: {name} is a bare rule; say on which grid it lives, macro(rule) or micro(rule).")
    if not isinstance(placed, PlacedRule):
        raise Refused(f"Scheme: {name} is {placed!r}; give macro(rule) or micro(rule).")
    if is_concrete(placed):
        total = float(placed.rule.weights.sum())
        if not abs(total - 1) < 1e-10:
            raise Refused(f"Scheme: the weights of the {name} rule sum to {total:.15g}; they must sum to 1.")


def fully_implicit(num_micro: int) -> Scheme:
    """V and W at the midpoint of every micro interval. Order 2, symmetric, implicit.

    Evaluations per macro step and Newton iteration: V num_micro, W num_micro. The first choice for stiff springs:
    ``omega h`` limits the step only of springs that turn, to ``omega h`` times the angle of a turn in the step
    (in radians) below about 2. Constraint forces act at the nodes, as in `fully_explicit`: a light link with two equal
    masses at its ends, together ``mass``, stretched by a force, swings about the direction of the force with
    ``omega = 2 sqrt(force / (mass length))`` and needs ``omega h < 2``.

    Args:
        num_micro: micro steps per macro step.
    """
    return Scheme(num_micro, kinetic=micro(midpoint), slow=micro(midpoint), fast=micro(midpoint))


def explicit_slow(num_micro: int, alpha=0.5) -> Scheme:
    """V as a kick at the macro nodes, W at the micro midpoints. Order 2 and symmetric at alpha = 1/2, else order 1.

    Evaluations per macro step: V once (the right node of a step is the left node of the next), W num_micro per
    Newton iteration. Unstable near the impulse resonances omega H = k pi.

    Args:
        num_micro: micro steps per macro step.
        alpha: part of the kick by V at the start of the macro step, see the top of this module.
    """
    return Scheme(num_micro, kinetic=micro(midpoint), slow=macro(affine(alpha)), fast=micro(midpoint))


def mollified_impulse(num_micro: int, alpha=0.5) -> Scheme:
    """`explicit_slow` with V at averaged fast positions, ``V(q_s, a(q_s, q_f))``: stable at the impulse resonances.

    Order 2 and symmetric at alpha = 1/2, else order 1. Evaluations per macro step: V once; W num_micro per Newton
    iteration as before, and as many again for the average, with their derivative: cheap where W is quadratic, else an
    iteration per micro step. See `vmri_jax.schemes.quadrature.mollified`.

    Args:
        num_micro, alpha: as of `explicit_slow`.
    """
    return Scheme(num_micro, kinetic=micro(midpoint), slow=mollified(macro(affine(alpha))), fast=micro(midpoint))


def fully_explicit(num_micro: int, alpha=0.5) -> Scheme:
    """V as a kick at the macro nodes, W as kicks at the micro nodes (impulse method, r-RESPA at alpha = 1/2).

    Order 2 and symmetric at alpha = 1/2, else order 1. Explicit for constant mass without constraints and forces: V
    once and W num_micro times per macro step, no Newton. Stable only for omega h < 2. The first choice if the fast
    motion is the motion of rigid links: under `fully_implicit`, too, their steps are bounded by omega h < 2.

    Args:
        num_micro: micro steps per macro step.
        alpha: part of the kicks at the start, by V of the macro step and by W of every micro step; see the top of this
            module.
    """
    return Scheme(num_micro, kinetic=micro(midpoint), slow=macro(affine(alpha)), fast=micro(affine(alpha)))


def takahashi_imada(num_micro: int) -> Scheme:
    """`fully_explicit` with corrected kicks. Order 2, symmetric; frequencies of harmonic vibrations are of order 4.

    The method is conjugate to a method of order 4 by a change of coordinates of O(h^2), see
    `vmri_jax.schemes.quadrature.gradient_corrected`. So phases of harmonic vibrations stay accurate; a period that
    depends on the amplitude is off by O(h^2), since the change shifts the amplitude of the start. With constraints
    frequencies are of order 2: the correction leaves out the constraint forces. It needs constant masses, is explicit
    without constraints, and is stable for ``omega h < 2 sqrt(3)``. Evaluations per macro step: V once and W num_micro
    times, each with a product of its Hessian, and one more product of the Hessian of W.

    Args:
        num_micro: micro steps per macro step.
    """
    return Scheme(
        num_micro,
        kinetic=micro(midpoint),
        slow=gradient_corrected(macro(trapezoidal)),
        fast=gradient_corrected(micro(trapezoidal)),
    )


def galerkin(num_micro: int, degree: int, rule: Rule | str = "gauss") -> Scheme:
    """One rule on every term of a degree-r path: order 2r with ``"gauss"`` (r nodes) or ``"lobatto"`` (r + 1 nodes).

    Symmetric for symmetric rules, implicit, also with constraints. Evaluations of V and W per macro step and Newton
    iteration: num_micro times the number of nodes (lobatto shares the nodes where micro intervals meet).

    On small constrained systems the cheapest way to small errors is a single interval of high degree, e.g.
    ``galerkin(1, 12, "lobatto")`` with five or six nodes to a period of the fastest vibration: steps of two periods.

    Args:
        num_micro: micro steps per macro step.
        degree: r, of the polynomials.
        rule: "gauss", "lobatto", or any `Rule`.
    """
    whole_number("galerkin: degree", degree)
    if isinstance(rule, str):
        if rule not in ("gauss", "lobatto"):
            raise Refused(f"galerkin: rule is {rule!r}; it must be 'gauss', 'lobatto' or a Rule.")
        rule = gauss(degree) if rule == "gauss" else lobatto(degree + 1)
    return Scheme(num_micro, degree, kinetic=micro(rule), slow=micro(rule), fast=micro(rule))

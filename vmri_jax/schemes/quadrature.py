"""Quadrature rules on [0, 1] as values: add them, scale them, repeat them, place them on a grid.

A rule is a list of nodes and weights; the integral of ``f`` over an interval of length ``T`` is
approximated by ``T * sum_i w_i f(theta_i T)``. Rules form a vector space, and nodes that coincide
merge, so that a sum of rules never evaluates an integrand twice at one place:

    trapezoidal = (left + right) / 2
    simpson     = (left + 4 * midpoint + right) / 6

Nodes are static (they decide which equations exist), weights are arrays and may be traced.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.polynomial import legendre

from vmri_jax.mechanics.arrays import Numbers, is_concrete, real_array, whole_number
from vmri_jax.refusals import Refused

NODE_TOLERANCE = 1e-12
"""Nodes closer than this are the same node."""


class Rule(eqx.Module):
    """Quadrature rule ``sum_i w_i f(theta_i)`` on [0, 1].

    Args:
        nodes: increasing numbers in [0, 1].
        weights: as many weights; any array, possibly traced.

    Raises:
        ValueError: nodes outside [0, 1], not increasing, or not as many as weights.
    """

    nodes: tuple[float, ...] = eqx.field(static=True)
    weights: Float[Numbers, "nodes"]
    __array_ufunc__ = None  # so that numpy scalars leave `alpha * rule` to __rmul__

    def __init__(self, nodes, weights):
        self.nodes = tuple(real_array("Rule: nodes", nodes, 1).tolist())
        self.weights = real_array("Rule: weights", weights)
        if not self.nodes or self.weights.shape != (len(self.nodes),):
            raise Refused(
                f"Rule: got {len(self.nodes)} nodes and weights of shape {self.weights.shape}; give one weight per "
                "node, and at least one node."
            )
        if any(not -NODE_TOLERANCE <= node <= 1 + NODE_TOLERANCE for node in self.nodes):
            raise Refused(f"Rule: nodes {self.nodes} must lie in [0, 1], the unit interval.")
        if any(b - a <= NODE_TOLERANCE for a, b in zip(self.nodes, self.nodes[1:], strict=False)):
            raise Refused(f"Rule: nodes {self.nodes} must increase strictly; add two rules to merge their nodes.")

    def __add__(self, other: "Rule") -> "Rule":
        if not isinstance(other, Rule):
            return NotImplemented
        return _merge(self.nodes + other.nodes, [self.weights, other.weights])

    def __mul__(self, factor) -> "Rule":
        if isinstance(factor, Rule):
            return NotImplemented
        return Rule(self.nodes, factor * self.weights)

    __rmul__ = __mul__

    def __neg__(self) -> "Rule":
        return self * -1.0

    def __sub__(self, other: "Rule") -> "Rule":
        return self + (-other)

    def __truediv__(self, divisor) -> "Rule":
        return self * (1 / divisor)

    def __call__(self, function: Callable) -> Any:
        """Approximate the integral of ``function`` over [0, 1]."""
        return sum(w * function(node) for node, w in zip(self.nodes, self.weights, strict=True))

    def repeat(self, count: int) -> "Rule":
        """Composite rule: this one on each of ``count`` equal subintervals, shared end nodes merged.

        Args:
            count: at least 1.
        """
        whole_number("repeat: the count", count)
        nodes = tuple((m + node) / count for m in range(count) for node in self.nodes)
        return _merge(nodes, [self.weights / count] * count)

    @property
    def order(self) -> int:
        """Number of moments ``sum_i w_i theta_i^k = 1 / (k + 1)``, k = 0, 1, ..., that hold.

        A rule of order p integrates polynomials of degree p - 1 exactly; its error on a smooth
        function over an interval of length h is O(h^(p+1)).
        """
        if not is_concrete(self.weights):
            raise Refused("Rule.order needs concrete weights; ask for it outside jit, vmap and grad.")
        x, w = 2 * np.array(self.nodes) - 1, np.asarray(self.weights)
        for k in range(2 * len(x) + 1):  # in Legendre polynomials, whose moments are well scaled
            moment = w @ legendre.legval(x, np.eye(k + 1)[k])
            if abs(moment - (k == 0)) > 1e-11:
                return k
        return 2 * len(x)

    @property
    def is_symmetric(self) -> bool:
        """Whether the rule is its own mirror image, ``theta -> 1 - theta``; needs concrete weights."""
        x, w = np.array(self.nodes), np.asarray(self.weights)
        return bool(np.allclose(x, 1 - x[::-1], rtol=0, atol=1e-12) and np.allclose(w, w[::-1], rtol=0, atol=1e-12))


def _merge(nodes: tuple[float, ...], weights: list) -> Rule:
    """The rule with all these nodes, where equal nodes are merged and their weights added in order."""
    order = np.argsort(nodes, kind="stable")
    sorted_nodes = np.asarray(nodes)[order]
    first = np.concatenate([[True], np.diff(sorted_nodes) > NODE_TOLERANCE])
    target = np.empty(len(nodes), dtype=int)
    target[order] = np.cumsum(first) - 1
    xp = jnp if any(isinstance(w, jax.Array) for w in weights) else np
    merged = xp.concatenate(weights)
    if not first.all():
        merged = jax.ops.segment_sum(merged, target, first.sum()) if xp is jnp else np.bincount(target, merged)
    else:
        merged = merged[order]
    return Rule(tuple(sorted_nodes[first]), merged)


def interpolatory(nodes) -> Rule:
    """Rule on n nodes that is exact for polynomials of degree n - 1.

    Args:
        nodes: increasing numbers in [0, 1].
    """
    Rule(nodes, np.ones(len(nodes)))  # refuses wrong nodes
    return Rule(nodes, interpolatory_weights(nodes))


def interpolatory_weights(nodes) -> np.ndarray:
    """The weights of `interpolatory`."""
    # moments in Legendre polynomials: sum_i w_i P_k(x_i) = 1 for k = 0, else 0
    x = 2 * np.asarray(nodes, dtype=float) - 1
    moments = np.zeros(len(x))
    moments[0] = 1.0
    return np.linalg.solve(legendre.legvander(x, len(x) - 1).T, moments)


def _roots(series) -> np.ndarray:
    """Roots of a Legendre series in [-1, 1], polished by one Newton step."""
    x = np.sort(legendre.legroots(series).real)
    return x - legendre.legval(x, series) / legendre.legval(x, legendre.legder(series))


def gauss(n: int) -> Rule:
    """Gauss-Legendre rule: n interior nodes, order 2n."""
    whole_number("gauss: the number of nodes", n)
    return interpolatory((_roots(np.eye(n + 1)[n]) + 1) / 2)


def lobatto(n: int) -> Rule:
    """Gauss-Lobatto rule: n >= 2 nodes including both ends, order 2n - 2."""
    whole_number("lobatto: the number of nodes", n, 2)
    interior = _roots(legendre.legder(np.eye(n)[n - 1])) if n > 2 else np.zeros(0)
    return interpolatory((np.concatenate([[-1.0], interior, [1.0]]) + 1) / 2)


def radau(n: int, end: Literal["left", "right"] = "right") -> Rule:
    """Gauss-Radau rule: n nodes including one end, order 2n - 1.

    Args:
        n: number of nodes.
        end: which one is a node.
    """
    whole_number("radau: the number of nodes", n)
    if end not in ("left", "right"):
        raise Refused(f"radau: end is {end!r}; it must be 'left' or 'right'.")
    interior = np.zeros(0)
    if n > 1:  # roots of (P_{n-1} + P_n) / (1 + x): the other nodes of the rule that includes x = -1
        quotient, _ = legendre.legdiv(np.eye(n + 1)[n] + np.eye(n + 1)[n - 1], [1.0, 1.0])
        interior = _roots(quotient)
    x = np.concatenate([[-1.0], interior])
    nodes = (x + 1) / 2 if end == "left" else np.sort((1 - x) / 2)
    return interpolatory(nodes)


def affine(alpha) -> Rule:
    """``alpha * left + (1 - alpha) * right``; order 2 for alpha = 1/2, else 1.

    Args:
        alpha: weight of the start of the interval, 1 - alpha is the weight of its end; a traced alpha is not checked.
            1/2 is the trapezoidal rule, 1 and 0 have one end alone. `vmri_jax.schemes.scheme` says how alpha changes a
            step.

    Raises:
        ValueError: alpha is not from 0 to 1.
    """
    value = real_array("affine: alpha", alpha, 0)
    if is_concrete(value) and not 0 <= value <= 1:
        raise Refused(
            f"affine: alpha is {alpha}; it must be from 0 to 1: it is the part of a kick that is given at the start of "
            "an interval, and 1 - alpha at its end. With other numbers one of these parts points backwards, and "
            "momenta at the nodes are off by more than half a kick."
        )
    return alpha * left + (1 - alpha) * right


left = Rule((0.0,), (1.0,))
right = Rule((1.0,), (1.0,))
midpoint = Rule((0.5,), (1.0,))
trapezoidal = (left + right) / 2
simpson = (left + 4 * midpoint + right) / 6


class PlacedRule(eqx.Module):
    """A rule with its grid: one copy per macro interval, or one copy per `every` micro intervals.

    every: micro intervals that one copy of a rule on the micro grid spans.
    mollified: whether the potential is evaluated at averaged fast positions, see `mollified`.
    gradient_corrected: whether a square of its gradient is subtracted from the potential, see `gradient_corrected`.
    """

    rule: Rule
    grid: Literal["macro", "micro"] = eqx.field(static=True)
    mollified: bool = eqx.field(static=True, default=False)
    gradient_corrected: bool = eqx.field(static=True, default=False)
    every: int = eqx.field(static=True, default=1)

    def composite(self, num_micro: int) -> Rule:
        """The composite rule of all copies on the macro interval [0, 1]."""
        return self.rule if self.grid == "macro" else self.rule.repeat(self.copies(num_micro))

    def copies(self, num_micro: int) -> int:
        """Number of copies of the rule on the macro interval."""
        return 1 if self.grid == "macro" else num_micro // self.every

    def evaluations(self, num_micro: int) -> int:
        """Number of nodes in a macro step; the node that two neighbouring steps share counts once."""
        nodes = self.composite(num_micro).nodes
        return len(nodes) - (nodes[0] <= NODE_TOLERANCE and nodes[-1] >= 1 - NODE_TOLERANCE)

    def order(self, num_micro: int) -> int:
        """Order of a scheme by this rule, for a term of fast variables. Their path has a corner at every micro node: a
        copy of the rule that spans several micro intervals acts by kicks at its nodes, and counts as order 2 at most.
        """
        return min(self.rule.order, 2) if self.copies(num_micro) < num_micro else self.rule.order

    def largest_gap(self, num_micro: int) -> float:
        """Largest distance of neighbouring nodes of all macro steps, in units of the macro step."""
        nodes = np.array(self.composite(num_micro).nodes)
        return float(np.diff(nodes, append=1 + nodes[0]).max())

    @property
    def is_local(self) -> bool:
        """Whether every micro interval has a copy of the rule of its own."""
        return self.grid == "micro" and self.every == 1

    @property
    def only_kicks(self) -> bool:
        """Whether all nodes are ends of the macro interval: kicks at macro nodes alone."""
        return self.grid == "macro" and self.only_ends

    @property
    def only_ends(self) -> bool:
        """Whether every node is an end of the interval that a copy of the rule spans: kicks at macro or micro nodes."""
        return all(min(node, 1 - node) <= NODE_TOLERANCE for node in self.rule.nodes)

    def in_words(self) -> str:
        """Name of the rule, and its grid."""
        how = ", at averaged fast positions" if self.mollified else ""
        how += ", corrected by its gradient" if self.gradient_corrected else ""
        if self.every > 1:
            return f"{_name(self.rule)} on every {self.every} micro intervals{how}"
        return f"{_name(self.rule)} on {'the macro' if self.grid == 'macro' else 'every micro'} interval{how}"


def _name(rule: Rule) -> str:
    """The name of a rule, or its nodes and weights if it has none."""
    n = len(rule.nodes)
    known = {"left end": left, "right end": right, "midpoint": midpoint, "trapezoidal rule": trapezoidal}
    known |= {"Simpson's rule": simpson, f"Gauss rule of {n} nodes": gauss(n)}
    known |= {f"Radau rule of {n} nodes with the {end} end": radau(n, end) for end in ("left", "right")}
    known |= {f"Lobatto rule of {n} nodes": lobatto(n)} if n > 1 else {}
    for name, other in known.items():
        both = zip((rule.nodes, rule.weights), (other.nodes, other.weights), strict=True)
        if len(other.nodes) == n and all(np.allclose(a, b, rtol=0, atol=NODE_TOLERANCE) for a, b in both):
            return name
    weights = ", ".join(f"{weight:.4g}" for weight in np.asarray(rule.weights))
    return f"rule of nodes {', '.join(f'{node:.4g}' for node in rule.nodes)} with weights {weights}"


def macro(rule: Rule) -> PlacedRule:
    """Place a rule on the macro interval: its nodes are visited once per macro step."""
    return _placed(rule, "macro")


def micro(rule: Rule, every: int = 1) -> PlacedRule:
    """Place a rule on every micro interval: ``rule.repeat(num_micro / every)`` of the macro interval.

    Args:
        rule: on [0, 1].
        every: micro intervals that one copy of the rule spans: a rate between the rates of the two grids.
            ``micro(trapezoidal, every=4)`` has its nodes at every fourth micro node. `every` must divide `num_micro` of
            the scheme; ``every=num_micro`` is `macro`.

    Raises:
        TypeError: `rule` is no Rule.
        ValueError: `every` is no integer of at least 1.
    """
    whole_number("micro: every", every)
    return replace(_placed(rule, "micro"), every=int(every))


def _placed(rule: Rule, grid: Literal["macro", "micro"]) -> PlacedRule:
    if not isinstance(rule, Rule):
        raise Refused(f"{grid}: rule is {rule!r}; give a Rule, e.g. midpoint or gauss(2).")
    return PlacedRule(rule, grid)


def mollified(placed: PlacedRule) -> PlacedRule:
    """The same nodes, with the slow potential at averaged fast positions: ``V(q_s, a(q_s, q_f))``.

    The average a is the mean of the fast motion from rest over the macro step
    (`vmri_jax.steppers.kicked.average_over_fast_motion`). Kicks by V then have the force ``a'(q)^T grad V``. Without
    the filter a', kicks resonate with vibrations of frequency omega where ``omega H = k pi``, at macro steps that are
    multiples of half a period: Garcia-Archilla, Sanz-Serna and Skeel, *Long-time-step methods for oscillatory
    differential equations* (1998), the mollified impulse method with LongAverage.
    """
    if not isinstance(placed, PlacedRule) or placed.grid != "macro" or not placed.only_ends:
        raise Refused(f"mollified: got {placed!r}; give kicks at the macro nodes, e.g. macro(trapezoidal).")
    return PlacedRule(placed.rule, placed.grid, mollified=True)


def gradient_corrected(placed: PlacedRule) -> PlacedRule:
    """The same nodes, with a square of the gradient subtracted from the potential.

    Fast kicks act through ``W - h^2/24 grad W . M^-1 grad W``, slow ones through
    ``V - H^2/24 grad V . M^-1 grad V - h^2/12 grad V . M^-1 grad W``, the last term where W is corrected too. With a
    free drift between the kicks this is the method of Takahashi and Imada, J. Phys. Soc. Jpn. 53 (1984), and Rowlands,
    J. Comput. Phys. 97 (1991). Its order is 2, its effective order 4: a change of coordinates by O(h^2) conjugates it
    to a method of order 4. Frequencies of harmonic vibrations do not depend on coordinates, and are of order 4 without
    that change.
    """
    if not isinstance(placed, PlacedRule) or not placed.only_ends or placed.mollified or placed.every > 1:
        raise Refused(
            f"gradient_corrected: got {placed!r}; give kicks at the nodes of a grid, e.g. micro(trapezoidal)."
        )
    return PlacedRule(placed.rule, placed.grid, gradient_corrected=True)

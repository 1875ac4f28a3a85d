"""The path of one macro step: piecewise polynomials in time, and where quadrature nodes fall on them.

Slow variables follow one polynomial of degree r over the macro interval, fast variables one per
micro interval. Each is given by its start and the *increments* of its control points from there,
``X(c) = X_0 + sum_j l_j(c) Delta_j`` on the r + 1 Gauss-Lobatto points (l_j: Lagrange basis), so that
velocities ``sum_j l_j'(c) Delta_j / dt`` come from increments directly, never from the difference of
two nearly equal positions: momenta keep full relative precision however small the step.
"""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vmri_jax.mechanics.arrays import Numbers
from vmri_jax.refusals import Refused
from vmri_jax.schemes.quadrature import NODE_TOLERANCE, PlacedRule, Rule, lobatto


def control_nodes(degree: int) -> np.ndarray:
    """The degree + 1 Gauss-Lobatto points on [0, 1]: 0 = c_0 < ... < c_r = 1."""
    return np.array(lobatto(degree + 1).nodes)


def lagrange_basis(degree: int, theta) -> np.ndarray:
    """Values ``l_j(x)`` of the Lagrange polynomials of the control nodes, shape (..., degree + 1).

    ``l_j(x) = prod_(i != j) (x - c_i) / (c_j - c_i)``: this formula is exactly 0 or 1 at the control nodes.
    """
    c, x = control_nodes(degree), np.asarray(theta, dtype=float)[..., None]
    roots = [np.delete(c, j) for j in range(degree + 1)]
    return np.stack([np.prod((x - c_i) / (c[j] - c_i), axis=-1) for j, c_i in enumerate(roots)], axis=-1)


def lagrange_derivative(degree: int, theta) -> np.ndarray:
    """Derivatives ``l_j'(x)`` of the Lagrange polynomials of the control nodes, shape (..., degree + 1)."""
    c, x = control_nodes(degree), np.asarray(theta, dtype=float)[..., None]
    # l_j'(x) = sum_(k != j) 1 / (c_j - c_k) prod_(i != j, k) (x - c_i) / (c_j - c_i)
    columns = []
    for j in range(degree + 1):
        roots = np.delete(c, j)
        products = [
            np.prod((x - np.delete(roots, k)) / (c[j] - np.delete(roots, k)), axis=-1) / (c[j] - roots[k])
            for k in range(degree)
        ]
        columns.append(sum(products))
    return np.stack(columns, axis=-1)


@dataclass(frozen=True)
class NodeGroup:
    """Nodes at the local coordinate ``c`` of every `step`-th of the micro intervals ``first <= m < stop``."""

    c: float
    first: int
    stop: int
    weights: Float[Numbers, "size"]
    step: int = 1

    @property
    def intervals(self) -> range:
        """Numbers of the micro intervals."""
        return range(self.first, self.stop, self.step)

    @property
    def size(self) -> int:
        """Number of nodes."""
        return len(self.intervals)


@dataclass(frozen=True)
class Nodes:
    """Quadrature nodes of one term on the macro interval, sorted into groups of equal local coordinate.

    A group is a slice of the micro intervals, so that sampling and its transpose are slices and pads of cost O(num_micro), without
    gather or scatter.
    """

    groups: tuple[NodeGroup, ...]
    num_micro: int
    degree: int

    @property
    def weights(self):
        """Weights of all nodes, group after group."""
        return jnp.concatenate([jnp.asarray(g.weights) for g in self.groups])

    def theta(self, group: NodeGroup) -> np.ndarray:
        """Positions of a group's nodes on the macro interval."""
        return (np.array(group.intervals) + group.c) / self.num_micro


def velocity_nodes(placed: PlacedRule, num_micro: int, degree: int) -> Nodes:
    """Nodes of a term that depends on velocities, which may jump where micro intervals meet.

    Raises:
        ValueError: a macro rule with a node on the border of two micro intervals.
    """
    groups = tuple(_group(placed, i, num_micro) for i in range(len(placed.rule.nodes)))
    for g in groups:
        if g.c == 0.0 and g.first > 0:
            raise Refused(
                f"macro rule: node {g.first / num_micro} falls on the border of two of the {num_micro} micro intervals, "
                "where the velocity is not defined; place this term with micro(...) or choose another rule."
            )
    return Nodes(groups, num_micro, degree)


def slow_velocity_nodes(placed: PlacedRule, num_micro: int, degree: int) -> Nodes:
    """Nodes of a term that depends on slow positions and velocities alone: the nodes of the rule, once on the macro interval."""
    groups = (_on_one_interval(placed.rule, i, num_micro) for i in range(len(placed.rule.nodes)))
    return Nodes(tuple(groups), num_micro, degree)


def position_nodes(placed: PlacedRule, num_micro: int, degree: int) -> tuple[Any, Nodes, Any]:
    """Nodes of a term that depends on positions only: (weight at 0, nodes inside, weight at 1).

    Nodes at the ends of the macro interval are kicks: they shift the momenta before or after the step, and are no part of its
    equations. Their weight is None if the rule has no such node. Where two copies of the rule meet, the right node of the first copy
    and the left node of the second are one node.
    """
    rule, size, every = placed.rule, placed.copies(num_micro), placed.every
    has_start, has_end = rule.nodes[0] <= NODE_TOLERANCE, rule.nodes[-1] >= 1 - NODE_TOLERANCE
    start = rule.weights[0] / size if has_start else None
    end = rule.weights[-1] / size if has_end else None
    groups = [_group(placed, i, num_micro) for i in range(has_start, len(rule.nodes) - has_end)]
    if size > 1 and (has_start or has_end):
        meeting = sum(w for w in (start, end) if w is not None)
        groups.insert(0, NodeGroup(0.0, every, num_micro, jnp.full(size - 1, meeting), every))
    return start, Nodes(tuple(groups), num_micro, degree), end


def _group(placed: PlacedRule, i: int, num_micro: int) -> NodeGroup:
    """Node i of the rule, in each of its copies."""
    if placed.grid == "macro":
        return _on_one_interval(placed.rule, i, num_micro)
    copies = placed.copies(num_micro)
    m, c = _interval_of(placed.rule.nodes[i], placed.every)
    return NodeGroup(c, m, num_micro, jnp.full(copies, placed.rule.weights[i] / copies), placed.every)


def _on_one_interval(rule: Rule, i: int, num_micro: int) -> NodeGroup:
    m, c = _interval_of(rule.nodes[i], num_micro)
    return NodeGroup(c, m, m + 1, rule.weights[i : i + 1])


def _interval_of(node: float, count: int) -> tuple[int, float]:
    """Number m of the interval that a node lies in, of `count` equal intervals of [0, 1], and its local coordinate there."""
    m = min(int(np.floor(node * count + NODE_TOLERANCE)), count - 1)
    c = node * count - m
    return m, 0.0 if abs(c) <= NODE_TOLERANCE else c

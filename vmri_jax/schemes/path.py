"""The path of one macro step: piecewise polynomials in time, and where quadrature nodes fall on them.

Slow variables follow one polynomial of degree r over the macro interval, fast variables one per
micro interval. Each is given by its start and the *increments* of its control points from there,
``X(c) = X_0 + sum_j l_j(c) Delta_j`` on the r + 1 Gauss-Lobatto points (l_j: Lagrange basis), so that
velocities ``sum_j l_j'(c) Delta_j / dt`` come from increments directly, never from the difference of
two nearly equal positions: momenta keep full relative precision however small the step.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from vmri_jax.mechanics.arrays import Numbers, library
from vmri_jax.refusals import Refused
from vmri_jax.schemes.quadrature import NODE_TOLERANCE, PlacedRule, lobatto


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
class Nodes:
    """The k quadrature nodes of one term on the macro interval.

    interval, c: (k,) micro interval of each node, and its local coordinate there.
    number: (k,) number of its weight among the distinct ones.
    distinct: the weights; the copies of a node have one.
    """

    interval: Int[np.ndarray, "k"]
    c: Float[np.ndarray, "k"]
    number: Int[np.ndarray, "k"]
    distinct: Float[Numbers, "w"]
    num_micro: int
    degree: int

    @property
    def weights(self):
        """(k,) weights."""
        return self.distinct[self.number]

    @property
    def theta(self) -> np.ndarray:
        """(k,) places on the macro interval."""
        return (self.interval + self.c) / self.num_micro


def velocity_nodes(placed: PlacedRule, num_micro: int, degree: int) -> Nodes:
    """Nodes of a term that depends on velocities, which may jump where micro intervals meet.

    Raises:
        ValueError: a macro rule with a node on the border of two micro intervals.
    """
    nodes = _nodes(placed, num_micro, degree, range(len(placed.rule.nodes)))
    between = (nodes.c == 0.0) & (nodes.interval > 0)
    if placed.grid == "macro" and between.any():
        raise Refused(
            f"macro rule: node {nodes.theta[between.argmax()]} falls on the border of two of the {num_micro} micro "
            "intervals, where the velocity is not defined; place this term with micro(...) or choose another rule."
        )
    return nodes


def position_nodes(placed: PlacedRule, num_micro: int, degree: int) -> tuple[Any, Nodes, Any]:
    """Nodes of a term that depends on positions only: (weight at 0, nodes inside, weight at 1).

    Nodes at the ends of the macro interval are kicks: they shift the momenta before or after the step, and are no part
    of its equations. Their weight is None if the rule has no such node. Where two copies of the rule meet, the right
    node of the first copy and the left node of the second are one node.
    """
    rule, copies, every = placed.rule, placed.copies(num_micro), placed.every
    has_start, has_end = rule.nodes[0] <= NODE_TOLERANCE, rule.nodes[-1] >= 1 - NODE_TOLERANCE
    start = rule.weights[0] / copies if has_start else None
    end = rule.weights[-1] / copies if has_end else None
    inside = range(has_start, len(rule.nodes) - has_end)
    meets = range(every, num_micro, every) if copies > 1 and (has_start or has_end) else range(0)
    meeting = sum(w for w in (start, end) if w is not None)
    return start, _nodes(placed, num_micro, degree, inside, meets, meeting), end


def _nodes(
    placed: PlacedRule, num_micro: int, degree: int, numbers, meets: range = range(0), meeting: Any = 0.0
) -> Nodes:
    """Some nodes of a rule, in each of its copies, after nodes of one weight at the starts of some micro intervals."""
    copies, on_macro = placed.copies(num_micro), placed.grid == "macro"
    starts = np.zeros(1, int) if on_macro else placed.every * np.arange(copies)
    at = [_interval_of(placed.rule.nodes[i], num_micro if on_macro else placed.every) for i in numbers]
    interval = np.concatenate([np.array(meets, int), *(starts + m for m, _ in at)])
    c = np.concatenate([np.zeros(len(meets)), *(np.full(len(starts), c) for _, c in at)])
    of = np.repeat(np.arange(1 + len(at)), [len(meets)] + [len(starts)] * len(at))
    weights = [meeting, *(placed.rule.weights[i] / copies for i in numbers)]
    return Nodes(interval, c, of, library(*weights).stack(weights), num_micro, degree)


def _interval_of(node: float, count: int) -> tuple[int, float]:
    """Number m of the interval that a node lies in, of `count` equal intervals of [0, 1], and its local coordinate
    there."""
    m = min(int(np.floor(node * count + NODE_TOLERANCE)), count - 1)
    c = node * count - m
    return m, 0.0 if abs(c) <= NODE_TOLERANCE else c

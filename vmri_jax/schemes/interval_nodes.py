"""Quadrature nodes in the micro intervals of a macro step, and the values of its path there."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vmri_jax.kernels import matmul
from vmri_jax.mechanics.arrays import library
from vmri_jax.mechanics.rows import Entries
from vmri_jax.schemes.equations import StepEquations
from vmri_jax.schemes.path import Nodes, lagrange_basis, lagrange_derivative


class IntervalPath(NamedTuple):
    """The path over one micro interval, with the n_v slow variables on which terms in the interval depend, see
    `vmri_jax.schemes.intervals.Intervals`.

    slow_start, slow: start and increments of the slow control points, of the whole macro step.
    fast_start, fast: start and increments of the fast control points of this interval.
    """

    slow_start: Float[Array, "n_v"]
    slow: Float[Array, "r n_v"]
    fast_start: Float[Array, "n_f"]
    fast: Float[Array, "r n_f"]


class IntervalNodes:
    """Quadrature nodes of a term, the same number in every micro interval that has nodes.

    Args:
        nodes: of the term.
        rows: numbers of some of them; a row has at most one node in each interval.
    """

    def __init__(self, nodes: Nodes, rows: list[np.ndarray]):
        n, r = nodes.num_micro, nodes.degree
        c, of = np.zeros((n, len(rows))), np.full((n, len(rows)), -1)
        for k, row in enumerate(rows):
            c[nodes.interval[row], k], of[nodes.interval[row], k] = nodes.c[row], nodes.number[row]
        self.has_nodes: np.ndarray = np.any(of >= 0, axis=1)
        if (of == of[0]).all():
            self.weights = nodes.distinct[of[:1]]  # of all intervals
        else:
            self.weights = library(nodes.distinct).append(nodes.distinct, 0.0)[of]
        self.c, self.theta = c, (np.arange(n)[:, None] + c) / n
        self.tables = {
            "q_s": lagrange_basis(r, self.theta)[..., 1:],
            "v_s": lagrange_derivative(r, self.theta)[..., 1:],
            "q_f": lagrange_basis(r, c)[..., 1:],
            "v_f": lagrange_derivative(r, c)[..., 1:],
        }

    @classmethod
    def of(cls, nodes: Nodes) -> "list[IntervalNodes]":
        """The nodes of a rule: one entry for all rows with a node in every interval, and one for each other row.

        So functions are evaluated at the nodes of their rule alone: a potential may not be defined elsewhere, and a
        rule on the macro step has no node in most intervals.
        """
        # row k has the nodes that are the k-th of their interval
        k = [np.sum(nodes.interval[:i] == m) for i, m in enumerate(nodes.interval)]
        rows = [np.flatnonzero(np.equal(k, number)) for number in range(max(k, default=-1) + 1)]
        everywhere = [row for row in rows if len(row) == nodes.num_micro]
        parts = [everywhere] if everywhere else []
        parts += [[row] for row in rows if len(row) < nodes.num_micro]
        return [cls(nodes, part) for part in parts]

    def sample(self, path: IntervalPath, equations: StepEquations, seen: Entries, m, names: tuple[str, ...]) -> list:
        """Values of the path at the k nodes of interval m, by name: times ``t`` (k,), ``q_s``, ``q_f``, ``v_s``,
        ``v_f`` (k, n).

        Slow variables on which no term depends have their values at the start of the macro step.
        """

        def values_at_nodes(name: str):
            if name == "t":
                return equations.t + equations.macro_dt * of_interval(self.theta, m)
            start, increments = (path.slow_start, path.slow) if name[2] == "s" else (path.fast_start, path.fast)
            table = of_interval(self.tables[name], m)
            is_start = isinstance(table, np.ndarray) and not table.any()  # there JAX has to know that nothing moves
            moved = jnp.zeros((len(table), start.size)) if is_start else matmul(table, increments)
            # q(c) = q_0 + sum_j l_j(c) Delta_j,  v(c) = sum_j l_j'(c) Delta_j / T, with T = H for slow and T = h for
            # fast variables
            if name[0] == "q":
                values = start + moved
            else:
                values = moved / (equations.macro_dt if name[2] == "s" else equations.micro_dt)
            return with_unseen(values, name, equations, seen) if name[2] == "s" else values

        return [values_at_nodes(name) for name in names]

    def evaluated(self, m, function, *paths):
        """``function(*paths)``, or zero without evaluation in intervals where the rule has no nodes."""
        if self.has_nodes.all():
            return function(*paths)
        if isinstance(m, int):
            return function(*paths) if self.has_nodes[m] else jnp.zeros(())
        return jax.lax.cond(jnp.asarray(self.has_nodes)[m], function, lambda *_: jnp.zeros(()), *paths)


def with_unseen(values, name: str, equations: StepEquations, seen: Entries):
    """All slow positions or velocities (k, n_s), "q_s" or "v_s", from the seen ones (k, n_v); the others stay at rest
    at the start."""
    at_rest = equations.q_s if name == "q_s" else jnp.zeros_like(equations.q_s)
    return seen.put(values, jnp.broadcast_to(at_rest, (len(values), at_rest.size)))


def of_interval(table, m):
    """The rows of a table for interval m; a constant, without a lookup, if the rows of all intervals are equal."""
    if len(table) == 1 or (isinstance(table, np.ndarray) and np.ptp(table, axis=0).max(initial=0.0) == 0.0):
        return table[0]
    return jnp.asarray(table)[m]

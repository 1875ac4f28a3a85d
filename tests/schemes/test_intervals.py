"""The equations cut into micro intervals are those of the whole step, at the nodes of the rules and nowhere else."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.steppers.test_linearization import SCHEMES, equations_and_unknowns
from vmri_jax import quadrature
from vmri_jax.schemes.intervals import Arriving, IntervalNodes, Intervals, IntervalUnknowns
from vmri_jax.schemes.path import position_nodes
from vmri_jax.schemes.quadrature import macro, micro


@jax.jit
def whole_and_cut(equations, x):
    """The equations of the step, and rows, arrival and slow equations of its intervals: one program, not hundreds of operations."""
    intervals, rows = Intervals(equations), []
    arriving = Arriving(equations.q_f, equations.micro_dt * equations.p_f, jnp.zeros(x.slow.shape[1]), 0.0 * x.slow)
    for m in range(equations.scheme.num_micro):
        residual, arriving = intervals.evaluate(m, IntervalUnknowns(x.fast[m], x.multiplier[m]), arriving, x.slow)
        rows.append(residual)
    impulses = intervals.slow_impulses(x.slow, x.slow_multiplier)
    slow, p_s = intervals.slow_rows(x.slow, impulses, arriving)
    return equations.evaluate(x), rows, arriving, ((slow, intervals.slow_constraints(x.slow)), p_s)


ALIKE = ("fully implicit", "one micro step", "gauss 2")
"""For --full: their nodes are among those of others."""


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.full if n in ALIKE else ()) for n in SCHEMES])
def test_intervals_add_up_to_the_step(name):
    equations, x = equations_and_unknowns(SCHEMES[name])
    (expected, (p_s, p_f)), rows, arriving, ((slow, g_slow), p_end) = whole_and_cut(equations, x)
    # an interval hands on the momentum at the start plus all impulses: away from the solution it differs by the rows that are left
    left = jnp.cumsum(expected.fast.sum(1), axis=0)
    fast = expected.fast.at[1:, 0].add(left[:-1])
    found = jnp.stack([r.fast for r in rows]), jnp.stack([r.multiplier for r in rows]), slow, g_slow
    for a, b in zip(found, (fast, expected.multiplier, expected.slow, expected.slow_multiplier), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-13)  # measured 4e-15
    np.testing.assert_allclose(arriving.p_f, equations.micro_dt * p_f + left[-1], atol=1e-12)
    np.testing.assert_allclose(p_end, p_s + slow.sum(0) / equations.micro_dt, atol=1e-12)


@pytest.mark.parametrize("num_micro", [1, 2, 3, 4, 5])
@pytest.mark.parametrize(
    "placed",
    [
        micro(quadrature.midpoint),
        micro(quadrature.simpson),
        micro(quadrature.trapezoidal),
        macro(quadrature.midpoint),
        macro(quadrature.gauss(2)),
        macro(quadrature.gauss(3)),
        macro(quadrature.lobatto(5)),
    ],
)
def test_functions_are_evaluated_at_the_nodes_of_the_rule_alone(placed, num_micro):
    """In each interval at each of its nodes, once, with its weight."""
    _, inside, _ = position_nodes(placed, num_micro, 1)
    expected = sorted(
        (m, (m + group.c) / num_micro, float(weight))
        for group in inside.groups
        for m, weight in zip(range(group.first, group.stop), np.asarray(group.weights), strict=True)
    )
    found = sorted(
        (m, float(theta), float(weight))
        for nodes in IntervalNodes.of(inside)
        for m in np.flatnonzero(nodes.has_nodes)
        for theta, weight in zip(nodes.theta[m], np.asarray(nodes.weights)[min(m, len(nodes.weights) - 1)], strict=True)
    )
    np.testing.assert_allclose(np.array(found), np.array(expected), atol=1e-15)

"""The equations cut into micro intervals are those of the whole step in the textbook, at the nodes of the rules and
nowhere else."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.steppers.test_linearization import SCHEMES, equations_and_unknowns
from tests.user_systems import bent_system
from vmri_jax import galerkin, textbook
from vmri_jax.mechanics.rows import Entries
from vmri_jax.schemes.discrete_lagrangian import lagrangian
from vmri_jax.schemes.equations import StepEquations, Unknowns
from vmri_jax.schemes.interval_nodes import IntervalNodes, IntervalPath
from vmri_jax.schemes.intervals import Intervals
from vmri_jax.schemes.path import lagrange_basis, lagrange_derivative, position_nodes, velocity_nodes
from vmri_jax.schemes.quadrature import gauss, lobatto, macro, micro, midpoint, radau, simpson, trapezoidal

T, H = 0.7, 0.3


def control_points(equations, x: Unknowns):
    """Slow (r + 1, n_s) and fast (num_micro r + 1, n_f) control points of a step."""
    ends = equations.q_f + jnp.cumsum(x.fast[:, -1], axis=0)
    starts = jnp.concatenate([equations.q_f[None], ends[:-1]])
    fast = jnp.concatenate([equations.q_f[None], (starts[:, None] + x.fast).reshape(-1, equations.q_f.size)])
    return jnp.concatenate([equations.q_s[None], equations.q_s + x.slow]), fast


@jax.jit
def whole_and_cut(equations, x):
    """The equations of the step from the textbook's action without kicks, with the fast position and the momenta at
    its end, and the values in its intervals."""
    system, scheme, t, H = equations.system, equations.scheme, equations.t, equations.macro_dt
    path, h, n = control_points(equations, x), equations.micro_dt, equations.scheme.num_micro

    def action(path, along):
        slow, fast = path
        free = textbook.discrete_lagrangian(system, scheme)(slow, fast, H)
        free += textbook.virtual_work(system, scheme, path, along, t, H)
        g, g_slow = textbook.constraints(system, scheme, slow, fast, t, H)
        of_multipliers = jnp.sum(x.multiplier.reshape(g[:-1].shape) * g[:-1])
        return h * free - of_multipliers - jnp.sum(x.slow_multiplier * g_slow[:-1]) / n

    slots = list(jax.grad(action)(path, path))
    for term in lagrangian(system, scheme).kicks:
        for weight, k in ((term.start, 0), (term.end, -1)):
            if weight is not None:
                impulses = term.gradient(*(points[k] for points in path))
                slots = [
                    d.at[k].add(-h * term.times_step(H) * weight * dp) for d, dp in zip(slots, impulses, strict=True)
                ]
    g, g_slow = textbook.constraints(system, scheme, *path, t, H)
    rows = [d.at[0].add(h * p)[:-1] for d, p in zip(slots, (equations.p_s, equations.p_f), strict=True)]
    expected = Unknowns(rows[0], g_slow[1:], rows[1].reshape(x.fast.shape), g[1:].reshape(x.multiplier.shape))
    return expected, (path[1][-1], *(d[-1] / h for d in slots)), Intervals(equations).residual(x)


ALIKE = ("fully implicit", "one micro step", "gauss 2")
"""For --full: their nodes are among those of others."""


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.full if n in ALIKE else ()) for n in SCHEMES])
def test_intervals_add_up_to_the_step_of_the_textbook(name):
    equations, x = equations_and_unknowns(SCHEMES[name])
    expected, end, (found, (q_f, p_s, p_f)) = jax.device_get(whole_and_cut(equations, x))
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-13)  # measured 8e-15
    # momenta from those at the start and all impulses: away from the solution they differ by the rows that are left
    np.testing.assert_allclose(q_f, end[0], atol=1e-14)
    np.testing.assert_allclose(p_s, end[1] + expected.slow.sum(0) / equations.micro_dt, atol=1e-12)
    np.testing.assert_allclose(p_f, end[2] + expected.fast.sum((0, 1)) / equations.micro_dt, atol=1e-12)


PLACED = micro(gauss(2)), micro(radau(2)), micro(simpson), macro(gauss(2)), macro(gauss(4))


@pytest.mark.parametrize(("degree", "num_micro"), [(1, 5), (2, 1), (3, 2)])
def test_intervals_sample_the_path_at_the_nodes_of_the_rule(degree, num_micro):
    rng = np.random.default_rng(degree + 10 * num_micro)
    slow, fast = rng.normal(size=(degree + 1, 2)), rng.normal(size=(num_micro * degree + 1, 3))
    system, scheme, names = bent_system(), galerkin(num_micro, degree), ("t", "q_s", "q_f", "v_s", "v_f")
    pieces = []  # nodes of all rules, and the number of an interval that has them
    for placed in PLACED:
        parts = IntervalNodes.of(velocity_nodes(placed, num_micro, degree))
        of_rule = [(nodes, int(m)) for nodes in parts for m in np.flatnonzero(nodes.has_nodes)]
        assert sum(len(nodes.theta[m]) for nodes, m in of_rule) == len(placed.rule.nodes) * placed.copies(num_micro)
        pieces += of_rule

    @jax.jit
    def sampled(slow, fast):
        equations = StepEquations(system, scheme, T, slow[0], fast[0], slow[0], fast[0], H)
        ends = fast[::degree]
        paths = [
            IntervalPath(slow[0], slow[1:] - slow[0], ends[m], fast[m * degree + 1 : (m + 1) * degree + 1] - ends[m])
            for m in range(num_micro)
        ]
        return [nodes.sample(paths[m], equations, Entries((True, True)), m, names) for nodes, m in pieces]

    for (nodes, m), found in zip(pieces, sampled(slow, fast), strict=True):
        theta, c, points = nodes.theta[m], nodes.c[m], fast[m * degree : (m + 1) * degree + 1]
        expected = (
            T + theta * H,
            lagrange_basis(degree, theta) @ slow,
            lagrange_basis(degree, c) @ points,
            lagrange_derivative(degree, theta) @ slow / H,
            lagrange_derivative(degree, c) @ points * num_micro / H,
        )
        for got, value in zip(found, expected, strict=True):
            np.testing.assert_allclose(got, value, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("num_micro", [1, 2, 3, 4, 5])
@pytest.mark.parametrize(
    "placed",
    [
        micro(midpoint),
        micro(simpson),
        micro(trapezoidal),
        macro(midpoint),
        macro(gauss(2)),
        macro(gauss(3)),
        macro(lobatto(5)),
    ],
)
def test_functions_are_evaluated_at_the_nodes_of_the_rule_alone(placed, num_micro):
    """In each interval at each of its nodes, once, with its weight."""
    _, inside, _ = position_nodes(placed, num_micro, 1)
    expected = sorted(zip(inside.interval, inside.theta, np.asarray(inside.weights), strict=True))
    found = sorted(
        (m, float(theta), float(weight))
        for nodes in IntervalNodes.of(inside)
        for m in np.flatnonzero(nodes.has_nodes)
        for theta, weight in zip(nodes.theta[m], np.asarray(nodes.weights)[min(m, len(nodes.weights) - 1)], strict=True)
    )
    np.testing.assert_allclose(np.array(found), np.array(expected), atol=1e-15)

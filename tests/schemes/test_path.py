"""Paths: Lagrange bases, interpolation, and where quadrature nodes fall on the micro intervals."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vmri_jax.schemes.path import (
    Path,
    control_nodes,
    lagrange_basis,
    lagrange_derivative,
    position_nodes,
    velocity_nodes,
)
from vmri_jax.schemes.quadrature import affine, gauss, left, lobatto, macro, micro, midpoint, radau, right, simpson

DEGREES = range(1, 7)
T, H = 0.7, 0.3


@pytest.mark.parametrize("degree", DEGREES)
def test_basis_is_the_identity_at_the_control_nodes(degree):
    assert np.array_equal(lagrange_basis(degree, control_nodes(degree)), np.eye(degree + 1))


@given(st.integers(1, 6), st.lists(st.floats(-1, 1), min_size=7, max_size=7), st.floats(0, 1))
def test_polynomials_of_the_degree_are_interpolated(degree, coefficients, x):
    f = np.polynomial.Polynomial(coefficients[: degree + 1])
    values = f(control_nodes(degree))
    assert lagrange_basis(degree, x) @ values == pytest.approx(f(x), abs=1e-13)
    assert lagrange_derivative(degree, x) @ values == pytest.approx(f.deriv()(x), abs=1e-11)


def random_path(degree, num_micro, n_s=2, n_f=3):
    rng = np.random.default_rng(degree + 10 * num_micro)
    slow, fast = rng.normal(size=(degree + 1, n_s)), rng.normal(size=(num_micro * degree + 1, n_f))
    return Path.from_control_points(slow, fast, T, H), slow, fast


@pytest.mark.parametrize(("degree", "num_micro"), [(1, 4), (2, 1), (3, 4)])
def test_control_points_go_in_and_come_out(degree, num_micro):
    path, slow, fast = random_path(degree, num_micro)
    assert (path.degree, path.num_micro) == (degree, num_micro)
    assert np.allclose(path.slow_control_points(), slow, rtol=0, atol=1e-15)
    q_s, q_f = path.control_points()
    assert np.allclose(q_f, fast, rtol=0, atol=1e-15)
    theta = [(m + c) / num_micro for m in range(num_micro) for c in control_nodes(degree)[bool(m) :]]
    assert np.allclose(q_s, lagrange_basis(degree, theta) @ slow, rtol=0, atol=1e-14)


def by_hand(slow, fast, degree, num_micro, theta, m):
    """The path at theta of the macro interval, taken in its micro interval m: t, q_s, q_f, v_s, v_f."""
    c = theta * num_micro - m
    points = fast[m * degree : (m + 1) * degree + 1]
    return (
        T + theta * H,
        lagrange_basis(degree, theta) @ slow,
        lagrange_basis(degree, c) @ points,
        lagrange_derivative(degree, theta) @ slow / H,
        lagrange_derivative(degree, c) @ points * num_micro / H,
    )


@pytest.mark.parametrize(("degree", "num_micro"), [(1, 5), (2, 1), (3, 2)])
@pytest.mark.parametrize("placed", [micro(gauss(2)), micro(radau(2)), micro(simpson), macro(gauss(2)), macro(gauss(4))])
def test_velocity_nodes_sample_the_path(degree, num_micro, placed):
    path, slow, fast = random_path(degree, num_micro)
    nodes = velocity_nodes(placed, num_micro, degree)
    sample, k = nodes.sample(path, ("t", "q_s", "q_f", "v_s", "v_f")), 0
    for group in nodes.groups:
        for m in range(group.first, group.stop):
            theta = (m + group.c) / num_micro
            expected = by_hand(slow, fast, degree, num_micro, theta, m)
            for got, value in zip(sample.values(), expected, strict=True):
                assert np.allclose(got[k], value, rtol=1e-12, atol=1e-12)
            k += 1
    # node positions and weights are those of the composite rule (velocity nodes do not merge)
    thetas = np.concatenate([nodes.theta(g) for g in nodes.groups])
    composite = placed.composite(num_micro)
    for power in range(4):
        assert nodes.weights @ thetas**power == pytest.approx(composite(lambda x, power=power: x**power), abs=1e-13)
    assert k == (len(placed.rule.nodes) * (num_micro if placed.grid == "micro" else 1))


def test_velocities_on_the_border_of_two_micro_intervals_are_refused():
    assert len(velocity_nodes(macro(midpoint), 3, 1).groups) == 1
    with pytest.raises(ValueError, match=r"node 0.5 falls on the border of two of the 2 micro"):
        velocity_nodes(macro(midpoint), 2, 1)


RULES = [left, right, midpoint, affine(0.3), simpson, gauss(2), gauss(3), lobatto(4), radau(2), radau(3, "left")]


@pytest.mark.parametrize("num_micro", [1, 2, 5])
@pytest.mark.parametrize("place", [macro, micro])
@pytest.mark.parametrize("rule", RULES)
def test_position_nodes_are_the_merged_composite_rule(num_micro, place, rule):
    start, inside, end = position_nodes(place(rule), num_micro, 2)
    nodes = [] if start is None else [(0.0, start)]
    for group in inside.groups:
        nodes += zip(inside.theta(group), np.asarray(group.weights), strict=True)
    nodes = sorted(nodes + ([] if end is None else [(1.0, end)]))
    composite = place(rule).composite(num_micro)
    assert np.allclose([theta for theta, _ in nodes], composite.nodes, rtol=0, atol=1e-14)
    assert np.allclose([w for _, w in nodes], composite.weights, rtol=0, atol=1e-14)
    assert sum(w for _, w in nodes) == pytest.approx(1, abs=1e-13)


def test_ends_are_kept_apart_only_where_the_rule_has_them():
    start, inside, end = position_nodes(macro(affine(0.25)), 7, 1)
    assert (start, inside.groups, end) == (0.25, (), 0.75)
    start, inside, end = position_nodes(micro(midpoint), 7, 1)
    assert (start, end) == (None, None)
    assert [g.size for g in inside.groups] == [7]

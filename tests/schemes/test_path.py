"""Paths: Lagrange bases, interpolation, and where quadrature nodes fall on the micro intervals."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vmri_jax.schemes.path import (
    control_nodes,
    lagrange_basis,
    lagrange_derivative,
    position_nodes,
    velocity_nodes,
)
from vmri_jax.schemes.quadrature import affine, gauss, left, lobatto, macro, micro, midpoint, radau, right, simpson

DEGREES = range(1, 7)


@pytest.mark.parametrize("degree", DEGREES)
def test_basis_is_the_identity_at_the_control_nodes(degree):
    assert np.array_equal(lagrange_basis(degree, control_nodes(degree)), np.eye(degree + 1))


@given(st.integers(1, 6), st.lists(st.floats(-1, 1), min_size=7, max_size=7), st.floats(0, 1))
def test_polynomials_of_the_degree_are_interpolated(degree, coefficients, x):
    f = np.polynomial.Polynomial(coefficients[: degree + 1])
    values = f(control_nodes(degree))
    assert lagrange_basis(degree, x) @ values == pytest.approx(f(x), abs=1e-13)
    assert lagrange_derivative(degree, x) @ values == pytest.approx(f.deriv()(x), abs=1e-11)


@pytest.mark.parametrize("num_micro", [1, 2, 5])
@pytest.mark.parametrize("placed", [micro(gauss(2)), micro(radau(2)), micro(simpson), macro(gauss(2)), macro(gauss(4))])
def test_velocity_nodes_are_the_composite_rule(num_micro, placed):
    nodes = velocity_nodes(placed, num_micro, 2)
    composite = placed.composite(num_micro)  # velocity nodes do not merge
    for power in range(4):
        assert nodes.weights @ nodes.theta**power == pytest.approx(
            composite(lambda x, power=power: x**power), abs=1e-13
        )


def test_velocities_on_the_border_of_two_micro_intervals_are_refused():
    assert len(velocity_nodes(macro(midpoint), 3, 1).theta) == 1
    with pytest.raises(ValueError, match=r"node 0.5 falls on the border of two of the 2 micro"):
        velocity_nodes(macro(midpoint), 2, 1)


RULES = [left, right, midpoint, affine(0.3), simpson, gauss(2), gauss(3), lobatto(4), radau(2), radau(3, "left")]


@pytest.mark.parametrize("num_micro", [1, 2, 5])
@pytest.mark.parametrize("place", [macro, micro])
@pytest.mark.parametrize("rule", RULES)
def test_position_nodes_are_the_merged_composite_rule(num_micro, place, rule):
    start, inside, end = position_nodes(place(rule), num_micro, 2)
    nodes = [] if start is None else [(0.0, start)]
    nodes += zip(inside.theta, np.asarray(inside.weights), strict=True)
    nodes = sorted(nodes + ([] if end is None else [(1.0, end)]))
    composite = place(rule).composite(num_micro)
    assert np.allclose([theta for theta, _ in nodes], composite.nodes, rtol=0, atol=1e-14)
    assert np.allclose([w for _, w in nodes], composite.weights, rtol=0, atol=1e-14)
    assert sum(w for _, w in nodes) == pytest.approx(1, abs=1e-13)


def test_ends_are_kept_apart_only_where_the_rule_has_them():
    start, inside, end = position_nodes(macro(affine(0.25)), 7, 1)
    assert (start, len(inside.theta), end) == (0.25, 0, 0.75)
    start, inside, end = position_nodes(micro(midpoint), 7, 1)
    assert (start, end) == (None, None)
    assert len(inside.theta) == 7

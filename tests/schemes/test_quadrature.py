"""Quadrature rules: exactness, the vector space they form, repetition, traced weights."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vmri_jax import quadrature
from vmri_jax.schemes.quadrature import (
    Rule,
    affine,
    gauss,
    left,
    lobatto,
    macro,
    micro,
    midpoint,
    radau,
    right,
    simpson,
)

FAMILIES = {
    "gauss": (gauss, 1, lambda n: 2 * n),
    "lobatto": (lobatto, 2, lambda n: 2 * n - 2),
    "radau": (radau, 1, lambda n: 2 * n - 1),
}
NAMED = [left, right, midpoint, quadrature.trapezoidal, simpson]
RULES = [*NAMED, gauss(3), lobatto(4), radau(2), radau(3, "left"), affine(0.3)]

rules = st.sampled_from(RULES)
factors = st.floats(-3, 3).filter(lambda a: abs(a) > 1e-3)
polynomials = st.lists(st.floats(-1, 1), min_size=1, max_size=16).map(np.polynomial.Polynomial)


def integral(polynomial):
    antiderivative = polynomial.integ()
    return antiderivative(1.0) - antiderivative(0.0)


def same(a: Rule, b: Rule):
    return np.allclose(a.nodes, b.nodes, atol=1e-14) and np.allclose(a.weights, b.weights, atol=1e-13)


@pytest.mark.parametrize("family", FAMILIES)
@given(data=st.data())
def test_exact_up_to_its_degree(family, data):
    make, least, order = FAMILIES[family]
    rule = make(n := data.draw(st.integers(least, 8)))
    polynomial = np.polynomial.Polynomial(
        data.draw(st.lists(st.floats(-1, 1), min_size=order(n), max_size=order(n)))  # degree order - 1
    )
    assert abs(rule(polynomial) - integral(polynomial)) < 1e-13  # measured 1e-16 on monomials


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("n", range(2, 9))
def test_order_and_no_more(family, n):
    make, _, order = FAMILIES[family]
    rule, p = make(n), order(n)
    assert rule.order == p
    assert len(rule.nodes) == n
    assert abs(float(np.sum(rule.weights)) - 1) < 1e-13
    # degree p is not exact
    assert abs(rule(lambda x: (2 * x - 1) ** p) - (p % 2 == 0) / (p + 1)) > 1e-5


def test_order_of_named_rules():
    assert [rule.order for rule in (*NAMED, affine(0.3), affine(0.5))] == [1, 1, 2, 2, 4, 1, 2]


@pytest.mark.parametrize("end", ["left", "right"])
def test_radau_includes_its_end(end):
    nodes = radau(4, end).nodes
    assert nodes[{"left": 0, "right": -1}[end]] == {"left": 0.0, "right": 1.0}[end]
    assert 0 < nodes[1] < nodes[2] < 1


@given(rules, rules, rules, factors, factors, polynomials)
def test_algebra_laws(r, s, t, a, b, f):
    assert same(r + s, s + r)
    assert same((r + s) + t, r + (s + t))
    assert same(a * (r + s), a * r + a * s)
    assert same((a + b) * r, a * r + b * r)
    assert same(r - s, r + (-s))
    assert same(r / a, (1 / a) * r)
    assert np.isclose((a * r)(f), a * r(f), rtol=0, atol=1e-12)
    assert np.isclose((r + s)(f), r(f) + s(f), rtol=0, atol=1e-12)
    assert np.isclose((r - s)(f), r(f) - s(f), rtol=0, atol=1e-12)


@given(st.sampled_from(RULES), st.integers(1, 7), st.integers(1, 4))
def test_repeat_keeps_the_order_and_merges_nodes(rule, n, m):
    repeated = rule.repeat(n)
    both_ends = rule.nodes[0] == 0.0 and rule.nodes[-1] == 1.0
    assert len(repeated.nodes) == n * len(rule.nodes) - both_ends * (n - 1)
    assert repeated.order == rule.order or (n == 1 and repeated.order >= rule.order)
    assert abs(float(np.sum(repeated.weights)) - 1) < 1e-13
    assert same(rule.repeat(n).repeat(m), rule.repeat(n * m))


@given(rules, st.integers(1, 6), polynomials)
def test_repeat_is_the_composite_rule(rule, n, f):
    by_hand = sum(rule(lambda x, m=m: f((m + x) / n)) / n for m in range(n))
    assert rule.repeat(n)(f) == pytest.approx(by_hand, abs=1e-12)


def test_merged_nodes_are_evaluated_once():
    visited = []

    def f(x):
        visited.append(x)
        return x**2

    value = (quadrature.trapezoidal.repeat(3) + simpson + 2 * left)(f)
    assert visited == pytest.approx([0, 1 / 3, 1 / 2, 2 / 3, 1], abs=1e-15)
    assert value == pytest.approx(quadrature.trapezoidal.repeat(3)(lambda x: x**2) + 1 / 3)


@pytest.mark.compiles
def test_alpha_may_be_traced():
    value = jax.jit(lambda alpha: affine(alpha)(jnp.exp))
    assert value(0.25) == pytest.approx(0.25 + 0.75 * np.e)
    assert float(jax.jit(jax.grad(lambda alpha: affine(alpha).repeat(2)(jnp.exp)))(0.25)) == pytest.approx(
        (1 - np.e) / 2
    )


def test_placed_rules():
    assert macro(simpson).composite(4).nodes == simpson.nodes
    assert len(micro(simpson).composite(4).nodes) == 9
    assert macro(affine(0.2)).only_ends
    assert not micro(simpson).only_ends


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Rule((0.0, 1.0), (1.0,)), "one weight per node"),
        (lambda: Rule((-0.1, 1.0), (0.5, 0.5)), r"lie in \[0, 1\]"),
        (lambda: Rule((0.5, 0.5), (0.5, 0.5)), "increase strictly; add two rules"),
        *((lambda n=n: gauss(n), "gauss: the number of nodes is") for n in (0, 1.5, True)),  # pyright: ignore[reportArgumentType]
        (lambda: lobatto(1), "lobatto: the number of nodes is"),
        (lambda: radau(0), "radau: the number of nodes is"),
        (lambda: radau(2, "middle"), "'left' or 'right'"),  # pyright: ignore[reportArgumentType]
        (lambda: jax.jit(lambda alpha: affine(alpha).order)(0.5), "concrete weights"),
    ],
)
def test_what_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()

"""Schemes as data: names, rules, orders."""

import jax
import numpy as np
import pytest

import vmri_jax as vm
from vmri_jax import Scheme, compose, explicit_slow, fully_explicit, fully_implicit, galerkin, macro, micro, quadrature

ON_MACRO, OFF = macro(quadrature.midpoint), macro(quadrature.Rule((0, 1), (0, 1)))
HALF, TWO, KICKS = micro(quadrature.midpoint), micro(quadrature.gauss(2)), micro(quadrature.trapezoidal)


@pytest.mark.parametrize(
    ("scheme", "slow", "fast"),
    [
        (fully_implicit(5), ("micro", (0.5,)), ("micro", (0.5,))),
        (explicit_slow(5, 0.3), ("macro", (0.0, 1.0)), ("micro", (0.5,))),
        (fully_explicit(5, 0.3), ("macro", (0.0, 1.0)), ("micro", (0.0, 1.0))),
    ],
    ids=["fully implicit", "explicit slow", "fully explicit"],
)
def test_reference_schemes(scheme, slow, fast):
    assert (scheme.num_micro, scheme.degree) == (5, 1)
    assert (scheme.slow.grid, scheme.slow.rule.nodes) == slow
    assert (scheme.fast.grid, scheme.fast.rule.nodes) == fast
    assert (scheme.constraint.grid, scheme.slow_constraint.grid) == ("micro", "macro")
    assert np.allclose(scheme.constraint.rule.weights, [0.5, 0.5])
    if slow[0] == "macro":
        assert np.allclose(scheme.slow.rule.weights, [0.3, 0.7])


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
@pytest.mark.parametrize("rule", ["gauss", "lobatto"])
def test_galerkin_schemes(degree, rule):
    scheme = galerkin(2, degree, rule)
    assert scheme.order == 2 * degree
    assert len(scheme.slow.rule.nodes) == degree + (rule == "lobatto")
    assert len(scheme.constraint.rule.nodes) == degree + 1


@pytest.mark.parametrize(
    ("scheme", "order"),
    [
        (fully_implicit(3), 2),
        (explicit_slow(3), 2),
        (explicit_slow(3, 0.4), 1),
        (fully_explicit(3, 1.0), 1),
        (galerkin(2, 1, quadrature.gauss(3)), 2),
        (galerkin(2, 3, quadrature.lobatto(3)), 4),
        (galerkin(2, 2, quadrature.radau(2)), 3),
        (Scheme(2, kinetic=HALF, slow=ON_MACRO, fast=ON_MACRO), 2),
        (Scheme(1, 2, kinetic=TWO, slow=macro(quadrature.gauss(2)), fast=TWO), 4),
        (Scheme(4, 2, kinetic=TWO, slow=macro(quadrature.gauss(2)), fast=TWO), 2),
    ],
)
def test_order_is_the_least_of_path_and_rules(scheme, order):
    assert scheme.order == order


def test_forces_take_the_rule_of_the_kinetic_energy_unless_told():
    rule = micro(quadrature.gauss(2))
    scheme = Scheme(2, 2, kinetic=rule, slow=rule, fast=rule)
    assert scheme.force.rule.nodes == rule.rule.nodes
    other = Scheme(2, 2, kinetic=rule, slow=rule, fast=rule, force=micro(quadrature.simpson))
    assert other.force.rule.nodes == quadrature.simpson.nodes


def test_schemes_of_one_structure_are_one_pytree_structure():
    assert jax.tree.structure(explicit_slow(5, 0.1)) == jax.tree.structure(explicit_slow(5, 0.9))
    assert jax.tree.structure(explicit_slow(5)) != jax.tree.structure(explicit_slow(6))
    assert jax.tree.structure(fully_implicit(5)) != jax.tree.structure(explicit_slow(5))


def test_potentials_have_rules_by_name():
    kicks = quadrature.trapezoidal
    scheme = fully_explicit(12).with_potentials(a=micro(kicks, every=4), b=macro(kicks)).with_potentials(b=micro(kicks))
    assert (scheme.rule_of("a").every, scheme.rule_of("b").every, scheme.rule_of(6).every) == (4, 1, 6)
    assert scheme.rule_of(12).grid == "macro"
    assert fully_explicit(4).with_potentials(a=micro(kicks, every=4)).rule_of("a").grid == "macro"
    assert scheme.rule_of("slow").grid == "macro"
    assert scheme.rule_of("fast").rule.nodes == scheme.fast.rule.nodes
    assert scheme.describe().evaluations == {"a": 3, "b": 12}
    assert "gradients of a  3 per macro step" in str(scheme.describe())
    assert compose(scheme, "suzuki4").describe().evaluations == {"a": 15, "b": 60}
    assert scheme.describe().rules["a"] == "trapezoidal rule on every 4 micro intervals"
    assert scheme.with_potentials(c=micro(quadrature.left)).order == 1
    assert not scheme.with_potentials(c=micro(quadrature.left)).is_symmetric
    base = fully_explicit(4)
    second = {2: micro(kicks, every=2), "a": micro(kicks)}
    rates = Scheme(4, kinetic=base.kinetic, slow=base.slow, fast=base.fast, potentials=second)
    assert "V_2" in str(rates.describe())
    assert list(jax.tree.map(np.asarray, rates).potentials) == [2, "a"]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: galerkin(2, 2, "simpson"), "rule is 'simpson'; it must be 'gauss', 'lobatto' or a Rule"),
        (
            lambda: Scheme(2, 3, kinetic=TWO, slow=TWO, fast=TWO),
            r"kinetic rule .* gives no positive kinetic energy to",
        ),
        (
            lambda: Scheme(2, kinetic=HALF, slow=HALF, fast=HALF, slow_constraint=OFF),
            "weight of the slow_constraint rule is zero",
        ),
        (lambda: micro(quadrature.midpoint, every=0), "micro: every"),
        (lambda: micro(quadrature.midpoint, every=1.5), "micro: every is 1.5"),  # pyright: ignore[reportArgumentType]
        (
            lambda: fully_explicit(8).with_potentials(bends=micro(quadrature.midpoint, every=3)),
            r"bends is placed with every=3, which does not divide num_micro=8: .* Take one of \[1, 2, 4, 8\]",
        ),
        (lambda: fully_explicit(8).rule_of(3), r"the potential 3 is placed with every=3"),
        (lambda: fully_explicit(8).rule_of("bends"), r"no rule for the potential 'bends'"),
        (
            lambda: fully_explicit(8).with_potentials(bends=quadrature.midpoint),  # pyright: ignore[reportArgumentType]
            "bends is a bare rule",
        ),
        (
            lambda: Scheme(4, kinetic=micro(quadrature.midpoint, every=2), slow=HALF, fast=HALF),
            "kinetic is placed with every=2; only potentials can be",
        ),
        (
            lambda: fully_explicit(8).with_potentials(bends=quadrature.gradient_corrected(KICKS)),
            "bends on the micro grid, degree 1, is corrected; only kicks of V and W",
        ),
    ],
)
def test_what_is_refused(make, message):
    with pytest.raises(vm.Refused, match=message):
        make()


def test_schemes_print_a_few_lines_that_say_what_they_are():
    scheme = explicit_slow(7)
    assert repr(scheme).splitlines()[:3] == [
        "Scheme",
        "  order           2, symmetric",
        "  path            7 micro steps of degree 1 per macro step",
    ]
    assert repr(compose(scheme, "suzuki4")).startswith("Composition\n  order           4, symmetric")
    assert "PlacedRule" in repr(jax.tree.map(lambda a: np.stack([a, a]), scheme))

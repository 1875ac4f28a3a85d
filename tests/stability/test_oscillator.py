"""The test equation under one rule, against closed forms."""

import numpy as np
import pytest

from vmri_jax import Scheme, explicit_slow, fully_explicit, fully_implicit, galerkin, macro, micro, takahashi_imada
from vmri_jax.schemes.quadrature import midpoint, trapezoidal
from vmri_jax.stability.oscillator import fast_limit, phase, slow_limit


@pytest.mark.parametrize("x", [0.3, 1.9, -0.7])
def test_phases_of_midpoint_and_verlet(x):
    assert phase(fully_implicit(3), x) == pytest.approx(2 * np.arctan(x / 2), rel=1e-14)
    assert phase(fully_explicit(3), x) == pytest.approx(2 * np.arcsin(x / 2), rel=1e-14)
    assert phase(takahashi_imada(3), x) == pytest.approx(2 * np.arcsin(x / 2 * np.sqrt(1 - x**2 / 12)), rel=1e-13)
    assert phase(explicit_slow(3), x) == phase(fully_implicit(3), x)


@pytest.mark.parametrize(("degree", "rule"), [(2, "gauss"), (2, "lobatto"), (3, "gauss"), (3, "lobatto")])
def test_phases_have_the_order_of_the_scheme(degree, rule):
    errors = [abs(phase(galerkin(1, degree, rule), x) - x) for x in (0.8, 0.4)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2 * degree + 1, abs=0.15)


def test_a_phase_beyond_half_a_turn():
    """Gauss collocation of degree 3 is accurate, and stable, far beyond pi."""
    assert phase(galerkin(1, 3), 4.0) == pytest.approx(4.0, abs=0.1)


def test_limits():
    assert fast_limit(fully_explicit(5)) == pytest.approx(2.0, abs=1e-7)
    assert np.isnan(phase(fully_explicit(5), 2.1))
    limits = fast_limit(takahashi_imada(5)), slow_limit(takahashi_imada(5))
    assert limits == pytest.approx((np.sqrt(12), np.sqrt(12)), abs=1e-7)
    assert slow_limit(explicit_slow(5, 0.3)) == pytest.approx(2.0, abs=1e-7)
    assert fast_limit(galerkin(3, 2, "lobatto")) == pytest.approx(np.sqrt(8), abs=1e-7)
    assert fast_limit(fully_implicit(5)) == fast_limit(galerkin(3, 3)) == slow_limit(fully_implicit(1)) == np.inf
    # a linear path over the macro interval with V at n midpoints: x^2 < 12 / (1 - 1 / n^2)
    assert slow_limit(fully_implicit(4)) == pytest.approx(np.sqrt(12 / (1 - 1 / 16)), abs=1e-7)
    on_macro = Scheme(3, kinetic=micro(midpoint), slow=micro(midpoint), fast=macro(trapezoidal))
    assert fast_limit(on_macro) == np.inf
    assert np.isnan(phase(on_macro, 1.0))

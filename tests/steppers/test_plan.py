"""Plans in words."""

from typing import Any

import jax.numpy as jnp
import pytest

import vmri_jax as vm
from vmri_jax.steppers.decoupled import Joined

FPU_EXPLICIT = """\
order           1, not symmetric
path            5 micro steps of degree 1 per macro step
T               midpoint on every micro interval
V               rule of nodes 0, 1 with weights 0.3, 0.7 on the macro interval
W               rule of nodes 0, 1 with weights 0.3, 0.7 on every micro interval
gradients of V  1 per macro step
gradients of W  5 per macro step
solves          none without constraints and forces; 1 per macro step with constraints between slow and fast
a step:
  kicks of V at both ends
    slow variables, one step:
      free flight: q + H v, nothing to solve
    fast variables, 5 micro steps:
      kicks of W at both ends
        free flight: q + H v, nothing to solve"""


def test_a_plan_describes_what_the_scheme_does_with_the_system(fpu):
    assert vm.plan(fpu.system, vm.fully_explicit(5, alpha=0.3), fpu.state()).describe() == FPU_EXPLICIT


def test_only_terms_of_the_system_are_described(tsp):
    rows = vm.plan(tsp.system, vm.compose(vm.explicit_slow(4), "yoshida4"), tsp.state()).describe().splitlines()
    step = rows.index("a step:")
    assert [row.split()[0] for row in rows[2:step]] == ["T", "V", "W", "g", "g_s", "gradients", "gradients", "solves"]
    assert rows[step + 1] == "  composition of 3 stages, each:"


@pytest.mark.parametrize(
    ("scheme", "words"),
    [
        (vm.explicit_slow(5), "trapezoidal rule on the macro interval"),
        (vm.explicit_slow(5, 1.0), "rule of nodes 0, 1 with weights 1, 0 on the macro interval"),
        (vm.mollified_impulse(5), "trapezoidal rule on the macro interval, at averaged fast positions"),
        (vm.takahashi_imada(5), "trapezoidal rule on the macro interval, corrected by its gradient"),
        (vm.galerkin(5, 3), "Gauss rule of 3 nodes on every micro interval"),
        (vm.galerkin(5, 3, "lobatto"), "Lobatto rule of 4 nodes on every micro interval"),
        (vm.galerkin(5, 2, vm.quadrature.radau(2)), "Radau rule of 2 nodes with the right end on every micro interval"),
        (vm.galerkin(5, 2, vm.quadrature.simpson), "Simpson's rule on every micro interval"),
    ],
)
def test_rules_in_words(scheme, words):
    assert scheme.describe().rules["V"] == words


THREE_RATES = """\
order               2, symmetric
path                32 micro steps of degree 1 per macro step
T                   midpoint on every micro interval
V                   trapezoidal rule on the macro interval
W                   trapezoidal rule on every micro interval
bends               trapezoidal rule on every 8 micro intervals
gradients of V      1 per macro step
gradients of W      32 per macro step
gradients of bends  4 per macro step
solves              none without constraints and forces; 1 per macro step with constraints between slow and fast
a step:
  kicks of V at both ends
    slow variables, one step:
      free flight: q + H v, nothing to solve
    fast variables, 4 steps:
      kicks of bends at both ends
        8 micro steps:
          kicks of W at both ends
            free flight: q + H v, nothing to solve"""


def bends(q_s, q_f, params):
    """Of fast variables alone."""
    return jnp.sum(jnp.cos(q_f))


def test_a_plan_of_three_rates(fpu):
    scheme = vm.fully_explicit(32).with_potentials(bends=vm.micro(vm.quadrature.trapezoidal, every=8))
    described = vm.plan(fpu.system.replace(potentials={"bends": bends}), scheme, fpu.state()).describe()
    assert described == THREE_RATES


def test_a_mollified_scheme_refuses_potentials_on_the_micro_grid(fpu):
    with pytest.raises(ValueError, match=r"mollified, .* the potentials bends are on the micro grid"):
        vm.plan(
            fpu.system.replace(potentials={"bends": bends}),
            vm.mollified_impulse(4).with_potentials(bends=vm.micro(vm.quadrature.midpoint)),
            fpu.state(),
        )


def test_slow_variables_are_joined_where_the_matrices_are_no_larger(fpu, tsp, sam):
    """Modes leave out the curvature of slow variables; an iteration with a diagonal or a kept matrix of the fast
    variables keeps to it."""
    steppers: dict[Any, Any] = {
        (name, scheme.degree): vm.plan(problem, scheme).stepper
        for name, problem in (("fpu", fpu), ("tsp", tsp), ("sam", sam))
        for scheme in (vm.fully_implicit(1), vm.galerkin(1, 3))
    }
    joined = {key for key, stepper in steppers.items() if isinstance(stepper.inner, Joined)}
    assert joined == {("tsp", 1), ("fpu", 3), ("tsp", 3), ("sam", 3)}
    assert steppers["sam", 3].inner.inner.solver.num_slow == sam.q_s.size

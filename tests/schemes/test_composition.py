"""Compositions: coefficients, order conditions, and that they are accepted wherever a scheme is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.support import PROBLEMS, compiled_step, convergence, ground_truth, without_fallback
from vmri_jax import compose, explicit_slow, fully_explicit, fully_implicit, galerkin
from vmri_jax.diagnostics import fit_order
from vmri_jax.schemes.composition import COMPOSITIONS

TRIPLE = (1 / (2 - 2 ** (1 / 3)), 1 - 2 / (2 - 2 ** (1 / 3)), 1 / (2 - 2 ** (1 / 3)))


@pytest.mark.parametrize("name", COMPOSITIONS)
def test_named_composition_meets_its_order_conditions(name):
    composed = compose(fully_explicit(3), name)
    assert composed.order == COMPOSITIONS[name].order == int(name[-1])
    assert composed.is_symmetric
    assert np.sum(composed.coefficients) == pytest.approx(1, abs=1e-14)


@pytest.mark.parametrize(
    ("scheme", "coefficients", "order"),
    [
        (fully_explicit(3), (0.5, 0.5), 2),
        (fully_explicit(3, 0.0), (0.5, 0.5), 1),
        (fully_explicit(3, 0.0), TRIPLE, 1),  # made for even powers only
        (fully_explicit(3), (0.3, 0.7), 2),
        (galerkin(2, 2), TRIPLE, 4),  # cancels h^3 where h^5 leads
        (galerkin(2, 2), (1 / (2 - 2**0.2), 1 - 2 / (2 - 2**0.2), 1 / (2 - 2**0.2)), 6),
        (compose(fully_explicit(3), "yoshida4"), (1 / (2 - 2**0.2), 1 - 2 / (2 - 2**0.2), 1 / (2 - 2**0.2)), 6),
        (galerkin(1, 8), (1.0,), 16),
    ],
)
def test_order_of_any_composition(scheme, coefficients, order):
    assert compose(scheme, coefficients).order == order


# macro steps on [0, 1] inside the asymptotic range, above round-off
STEPS = {
    ("fpu", "yoshida4"): (200, 400, 800),
    ("fpu", "suzuki4"): (200, 400, 800),
    ("fpu", "kahan-li6"): (100, 150, 200),
    ("fpu", "yoshida6"): (200, 300, 400),
    ("fpu", "kahan-li8"): (50, 70, 100),
    ("fpu", "suzuki-umeno8"): (50, 70, 100),
    ("tsp", "suzuki4"): (400, 800, 1600),
    ("tsp", "kahan-li6"): (150, 200, 300),
    ("tsp", "kahan-li8"): (70, 80, 100),
}


LONG = ("tsp", "suzuki4"), ("tsp", "kahan-li8")
"""For --full: coefficients meet their conditions whatever the system; with constraints order 6 shows that stages are
put together rightly."""


@pytest.mark.parametrize(
    ("name", "composition"), [pytest.param(*c, marks=pytest.mark.full if c in LONG else ()) for c in STEPS]
)
def test_observed_order(name, composition):
    truth = ground_truth({"fpu": "fpu3_t1", "tsp": "tsp_t1"}[name])
    scheme = compose(fully_explicit(5), composition)
    macro_dt, *errors = convergence(PROBLEMS[name](), scheme, truth, STEPS[name, composition], num_saves=10)
    observed = [fit_order(macro_dt, e, floor=1e-13).order for e in errors]
    assert observed == pytest.approx([scheme.order] * 2, abs=0.25)


def test_observed_order_where_only_v_is_explicit():
    scheme = compose(explicit_slow(5), "kahan-li6")
    macro_dt, *errors = convergence(PROBLEMS["fpu"](), scheme, ground_truth("fpu3_t1"), (50, 80, 100), num_saves=10)
    observed = [fit_order(macro_dt, e, floor=1e-13).order for e in errors]
    assert observed == pytest.approx([scheme.order] * 2, abs=0.25)


@pytest.mark.parametrize(
    ("name", "base"),
    [("fpu", explicit_slow(3)), ("tsp", fully_explicit(3))]
    + [pytest.param(name, fully_implicit(3), marks=pytest.mark.full) for name in ("fpu", "tsp")],
)
def test_equals_its_stages_one_by_one(name, base):
    problem, dt = PROBLEMS[name](), 0.01
    scheme = compose(base, "suzuki4")
    run = vm.simulate(problem.system, scheme, problem.state(), macro_dt=dt, num_steps=3, save=vm.Save(micro=True))
    state, micro, solver = problem.state(), [], without_fallback(problem, base)
    for _ in range(3):
        micro.append([])
        for c in np.asarray(scheme.coefficients):
            state, info = compiled_step(problem.system, base, state, c * dt, solver)
            micro[-1].append(info.q_f_micro)
    end = run.final_state
    for ours, theirs in ((end.q_s, state.q_s), (end.q_f, state.q_f), (end.p_s, state.p_s), (end.p_f, state.p_f)):
        np.testing.assert_allclose(ours, theirs, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(run.q_f_micro, np.reshape(micro, run.q_f_micro.shape), rtol=1e-10, atol=1e-10)
    assert run.q_f_micro.shape == (3, scheme.num_micro, problem.q_f.size)
    assert run.t_micro[:, -1] == pytest.approx(run.t[1:])
    assert run.t_micro[0, 2] == pytest.approx(dt * scheme.coefficients[0])


def test_keeps_constraints_and_symmetry():
    problem = PROBLEMS["tsp"]()
    scheme = compose(fully_explicit(5), "kahan-li6")  # as for the order
    there = vm.simulate(problem.system, scheme, problem.state(), macro_dt=0.02, num_steps=100)
    assert there.constraint_residual.max() < 1e-12
    end = there.final_state
    turned = vm.State(end.t, end.q_s, end.q_f, -end.p_s, -end.p_f)
    back = vm.simulate(problem.system, scheme, turned, macro_dt=0.02, num_steps=100).final_state
    np.testing.assert_allclose(back.q_f, problem.q_f, atol=1e-10)


def test_derivative_by_the_step():
    problem = PROBLEMS["fpu"]()
    scheme = compose(fully_explicit(3), "yoshida4")

    def end(dt):
        return vm.simulate(problem.system, scheme, problem.state(), macro_dt=dt, num_steps=5).q_s[-1, 0]

    program = jax.jit(jax.value_and_grad(end))
    difference = (program(0.02 + 1e-6)[0] - program(0.02 - 1e-6)[0]) / 2e-6
    assert float(program(0.02)[1]) == pytest.approx(float(difference), rel=1e-7)


def test_a_sweep_over_coefficients_traces_once():
    traced = []

    def spring(q_f, params):
        traced.append(1)
        return jnp.sum(q_f**2)

    one = jnp.ones(1)
    system = vm.System(vm.ConstantMass(one, one), lambda q_s, q_f, _: jnp.sum((q_s - q_f) ** 4), spring)
    state = vm.initial_state(system, one, one, one, one)
    vm.simulate(system, compose(fully_explicit(3), TRIPLE), state, macro_dt=0.01, num_steps=10)
    before = len(traced)
    vm.simulate(system, compose(fully_explicit(3), (0.2, 0.3, 0.5)), state, macro_dt=0.01, num_steps=10)
    assert len(traced) == before > 0


def test_describe_counts_stages():
    text = str(compose(explicit_slow(10), "suzuki4").describe())
    assert "order           4, symmetric" in text
    assert "50 micro steps of degree 1 per macro step, in 5 stages" in text
    described = compose(fully_explicit(10), "kahan-li8").describe()
    assert (described.slow_evaluations, described.fast_evaluations, described.solves) == (17, 170, 0)
    described = galerkin(4, 3, "lobatto").describe()
    assert (described.order, described.slow_evaluations, described.fast_evaluations, described.solves) == (6, 12, 12, 1)
    assert fully_explicit(4, 0.3).describe().symmetric is False
    assert explicit_slow(4).describe().solves == 4


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((fully_explicit(3), "yoshida5"), "there are yoshida4"),
        ((fully_explicit(3, 0.0), "yoshida4"), "not symmetric"),
        ((galerkin(3, 2), "yoshida4"), "order 4"),
        ((fully_explicit(3), (0.5, 0.4)), "sum to 0.9"),
        ((fully_explicit(3), (0.5, 0.0, 0.5)), "none zero"),
        ((fully_explicit(3), ()), "shape"),
        ((3, "yoshida4"), "give a Scheme"),
    ],
)
def test_refuses(arguments, words):
    with pytest.raises(vm.Refused, match=words):
        compose(*arguments)

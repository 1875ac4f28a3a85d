"""Adjoints that keep all steps, and in parts: the same derivatives, less memory, lanes, second derivatives."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.support import PROBLEMS
from tests.user_systems import LENGTH, cart, own_rod
from vmri_jax.running import engine, loops


def heavy(q_f, params):
    return params * q_f[1]


CHAIN = vm.systems.fermi_pasta_ulam(1)
PENDULUM = vm.Problem(
    vm.System(vm.ConstantMass([], [1.0, 1.0]), fast_potential=heavy, constraint=own_rod, params=jnp.asarray(9.81)),
    [],
    [LENGTH, 0.0],
    [],
    [0.0, 0.5],
)
SWING = vm.Problem(
    vm.System(vm.ConstantMass([], [1.0]), fast_potential=lambda q_f, params: -params * jnp.cos(q_f[0]), params=9.81),
    [],
    [1.0],
    [],
    [0.5],
)
SIMPLE = {"kicks": vm.fully_explicit(2), "solved": vm.fully_implicit(1)}
LONG = ("fpu", "tsp", "cart", "pendulum", "composed")
"""For --full: `test_parts` has steps that are solved, with and without constraints, in parts."""
CASES = {  # problem, scheme, macro_dt, steps
    "fpu": (PROBLEMS["fpu"], vm.fully_implicit(4), 0.02, 40),
    "tsp": (PROBLEMS["tsp"], vm.fully_implicit(3), 0.01, 40),
    "cart": (cart, vm.fully_explicit(2), 0.05, 40),
    "pendulum": (lambda: PENDULUM, vm.fully_explicit(2), 0.05, 40),
    "kicks": (lambda: CHAIN, vm.fully_explicit(2), 0.05, 40),
    "composed": (cart, vm.compose(vm.fully_explicit(2), "suzuki4"), 0.05, 12),
}


def cost_of(problem: vm.Problem, scheme, macro_dt, steps, save: vm.Save, solver=None):
    """A function of everything a run depends on and tells, ``cost(params, p_s, p_f, macro_dt)``, and where to take
    it."""
    state, system = problem.state(), problem.system

    def cost(params, p_s, p_f, macro_dt):
        start = vm.State(state.t, state.q_s, state.q_f, p_s, p_f)
        how = {"macro_dt": macro_dt, "num_steps": steps, "save": save, "solver": solver}
        run = vm.simulate(system.replace(params=params), scheme, start, **how)
        inside = jnp.sum(jnp.sin(run.q_f_micro)) + jnp.sum(run.t_micro) if save.micro else 0.0
        ends = jnp.sum(jnp.cos(run.q_f[1:])) + jnp.sum(run.q_s[-1] ** 2) + jnp.sum(run.p_s[1] ** 2) + jnp.sum(run.t)
        return ends + jnp.mean(run.energy) + inside

    return cost, (jax.tree.map(jnp.asarray, system.params), state.p_s, state.p_f, jnp.asarray(macro_dt))


def simple_cost(steps="solved"):
    """Of a single angle, a function of the momentum at the start alone."""
    cost, at = cost_of(SWING, SIMPLE[steps], 0.05, 6, vm.Save(6), vm.Solver("masses"))
    return (lambda p_f: cost(at[0], at[1], p_f, at[3])), at[2]


@cache
def simple_gradient(steps="solved"):
    """Value and gradient of `simple_cost`, compiled."""
    return jax.jit(jax.value_and_grad(simple_cost(steps)[0]))


def gradient(case: str, every: int, micro: bool = False):
    """All derivatives of a case in a row."""
    make, scheme, macro_dt, steps = CASES[case]
    solver = vm.Solver("masses") if case != "composed" else None
    cost, at = cost_of(make(), scheme, macro_dt, steps, vm.Save(every, micro=micro), solver)
    derivatives = jax.jit(jax.grad(cost, argnums=(0, 1, 2, 3)))(*at)
    return np.concatenate([np.ravel(a) for a in jax.tree.leaves(derivatives)])


stored_gradient = cache(gradient)


def assert_agree(derivatives, expected, tolerance=1e-10):
    """Measured: 1e-14 to 1e-12."""
    assert np.max(np.abs(derivatives - expected)) <= tolerance * np.max(np.abs(expected))


@pytest.fixture
def in_parts(monkeypatch):
    """A function after whose call short runs are differentiated in parts, too."""

    def divide(most_undivided: int = 3):
        monkeypatch.setattr(loops, "MOST_UNDIVIDED", most_undivided)
        monkeypatch.setattr(loops, "MOST_STORED_NUMBERS", 0)
        engine.engine.cache_clear()  # programs without parts

    yield divide
    engine.engine.cache_clear()


@pytest.mark.parametrize("case", [pytest.param(c, marks=pytest.mark.full if c in LONG else ()) for c in CASES])
def test_derivatives_in_parts(case, in_parts):
    """Of macro nodes and of micro nodes; gradients of `test_parts` see macro nodes alone."""
    expected = stored_gradient(case, 4, micro=True)
    in_parts()
    assert_agree(gradient(case, 4, micro=True), expected)


@pytest.mark.full
def test_parts_of_steps_that_are_solved(in_parts):
    expected = simple_gradient()(simple_cost()[1])[1]
    in_parts()
    cost, p_f = simple_cost()
    assert_agree(jax.jit(jax.grad(cost))(p_f), expected, 1e-11)


def memory(steps: int) -> float:
    """Bytes that the program of a gradient needs besides what goes in and out."""
    cost, at = cost_of(CHAIN, vm.fully_explicit(2), 0.02, steps, vm.Save(steps))
    analysis = jax.jit(jax.grad(cost)).lower(*at).compile().memory_analysis()
    assert analysis is not None
    return analysis.temp_size_in_bytes


def test_memory_of_long_gradients():
    """From 10^3 stored states to 10^6 steps in a thousand parts: about twice the states."""
    assert memory(1_000_000) < 4 * memory(1000)


@pytest.mark.full
def test_where_masses_fail_exact_matrices_are_differentiated(in_parts):
    """With steps that passes with masses do not solve."""
    problem, found = PROBLEMS["tsp"](), []
    for prepare in (lambda: None, in_parts):
        prepare()
        cost, at = cost_of(problem, vm.fully_implicit(1), 0.3, 4, vm.Save(2))
        found.append(jax.jit(jax.grad(cost))(*at))
    run = vm.simulate(problem, vm.fully_implicit(1), macro_dt=0.3, num_steps=4)
    assert max(run.info.method) == vm.Method.EXACT
    for a, b in zip(*map(jax.tree.leaves, found), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6)


def test_lanes_of_gradients(in_parts):
    cost, at = simple_cost("kicks")
    starts = np.stack([at, 1.1 * np.asarray(at)])
    expected = simple_gradient("kicks")(starts[1])[1]
    in_parts()
    lanes = jax.jit(jax.vmap(jax.grad(cost)))(starts)
    np.testing.assert_allclose(lanes[1], expected, rtol=1e-11, atol=1e-12)


def reverse(gradient):
    return jax.grad(lambda p_f: gradient(p_f)[0])


def forward(gradient):
    return lambda p_f: jax.jvp(gradient, (p_f,), (np.ones(1),))[1]


@pytest.mark.parametrize(("second", "steps"), [(reverse, "solved"), (forward, "kicks")])
def test_second_derivatives(second, steps, in_parts):
    """Reverse over reverse, and forward over reverse in parts; `tests/verification/test_gradients.py` has steps under
    forward over forward."""
    program, (cost, at), h = simple_gradient(steps), simple_cost(steps), 1e-5
    at = np.asarray(at)  # of a single fast variable
    expected = (program(at + h)[1] - np.asarray(program(at - h)[1])) / (2 * h)
    if steps == "kicks":
        in_parts()
    np.testing.assert_allclose(jax.jit(second(jax.grad(cost)))(at), expected, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("derivative", [jax.grad, jax.jacfwd])
def test_derivatives_of_a_failed_run_are_no_numbers(derivative):
    """From the failure on, and of the nodes before it they are numbers: a point that passes the pole of a logarithm."""
    system = vm.System(vm.ConstantMass([], [1.0]), fast_potential=lambda q_f, params: -0.01 * jnp.log(1.0 - q_f[0]))

    def position(v, number):
        problem = vm.Problem(system, [], [0.0], [], v * jnp.ones(1))
        return vm.simulate(problem, vm.fully_explicit(1), macro_dt=0.1, num_steps=10).q_f[number, 0]

    by_velocity = jax.jit(derivative(position))
    assert float(by_velocity(3.0, 1)) == pytest.approx(0.1, rel=1e-3)  # the step; without the force equal to it
    assert np.isnan(by_velocity(3.0, -1))


def test_a_gradient_has_the_values_of_the_run():
    """The steps of both are the same, up to the round-off of their two programs: the value of a gradient is no Newton
    step beside the root."""
    cost, at = simple_cost()
    value, expected = simple_gradient()(at)[0], jax.jit(cost)(at)
    assert float(value) == pytest.approx(float(expected), rel=1e-14)  # 2e-16; the same bits without optimisations

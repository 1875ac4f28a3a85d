"""Adjoints of runs against each other: the same derivatives, less memory, lanes, second derivatives, what they refuse, and which one auto takes."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.support import PROBLEMS
from tests.user_systems import LENGTH, cart, own_rod
from vmri_jax.running import engine, loops, simulation


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
SIMPLE = {"kicks": vm.fully_explicit(2), "solved": vm.fully_implicit(1)}
LONG = ("fpu", "kicks", "tsp", "cart", "composed")
CASES = {  # problem, scheme, macro_dt, steps
    "fpu": (PROBLEMS["fpu"], vm.fully_implicit(4), 0.02, 40),
    "tsp": (PROBLEMS["tsp"], vm.fully_implicit(3), 0.01, 40),
    "cart": (cart, vm.fully_explicit(2), 0.05, 40),
    "pendulum": (lambda: PENDULUM, vm.fully_explicit(2), 0.05, 40),
    "kicks": (lambda: CHAIN, vm.fully_explicit(2), 0.05, 40),
    "composed": (cart, vm.compose(vm.fully_explicit(2), "suzuki4"), 0.05, 12),
}


def cost_of(problem: vm.Problem, scheme, macro_dt, steps, save: vm.Save, solver=None):
    """A function of everything a run depends on and tells, ``cost(params, p_s, p_f, macro_dt)``, and where to take it."""
    state, system = problem.state(), problem.system

    def cost(params, p_s, p_f, macro_dt):
        start = vm.State(state.t, state.q_s, state.q_f, p_s, p_f)
        run = vm.simulate(
            system.replace(params=params),
            scheme,
            start,
            macro_dt=macro_dt,
            num_steps=steps,
            save=save,
            solver=solver,
        )
        inside = jnp.sum(jnp.sin(run.q_f_micro)) + jnp.sum(run.t_micro) if save.micro else 0.0
        ends = jnp.sum(jnp.cos(run.q_f[1:])) + jnp.sum(run.q_s[-1] ** 2) + jnp.sum(run.p_s[1] ** 2) + jnp.sum(run.t)
        return ends + jnp.mean(run.energy) + inside

    return cost, (jax.tree.map(jnp.asarray, system.params), state.p_s, state.p_f, jnp.asarray(macro_dt))


def simple_cost(adjoint, steps="solved"):
    """Of a small system without constraints, a function of the momenta at the start alone."""
    cost, at = cost_of(CHAIN, SIMPLE[steps], 0.05, 6, vm.Save(6, adjoint=adjoint), vm.Solver("masses"))
    return (lambda p_f: cost(at[0], at[1], p_f, at[3])), at[2]


@cache
def simple_gradient(adjoint, steps="solved"):
    """Of `simple_cost`, compiled."""
    return jax.jit(jax.grad(simple_cost(adjoint, steps)[0]))


@cache
def gradient(case: str, every: int, adjoint: str, micro: bool = False):
    """All derivatives of a case in a row."""
    make, scheme, macro_dt, steps = CASES[case]
    solver = vm.Solver("masses") if case != "composed" else None
    cost, at = cost_of(make(), scheme, macro_dt, steps, vm.Save(every, micro=micro, adjoint=adjoint), solver)
    derivatives = jax.jit(jax.grad(cost, argnums=(0, 1, 2, 3)))(*at)
    return np.concatenate([np.ravel(a) for a in jax.tree.leaves(derivatives)])


def assert_agree(derivatives, expected, tolerance=1e-10):
    """Measured: 1e-14 to 1e-12."""
    assert np.max(np.abs(derivatives - expected)) <= tolerance * np.max(np.abs(expected))


@pytest.mark.parametrize("case", [pytest.param(c, marks=pytest.mark.full if c in LONG else ()) for c in CASES])
def test_the_adjoints_agree(case):
    """Derivatives of macro nodes and of micro nodes."""
    assert_agree(gradient(case, 4, "checkpoint", micro=True), gradient(case, 4, "stored", micro=True))


@pytest.fixture
def short_parts(monkeypatch):
    monkeypatch.setattr(loops, "MOST_UNDIVIDED", 3)
    monkeypatch.setattr(engine, "MOST_STORED_STEPS", 1)
    engine.engine.cache_clear()  # programs without parts
    yield
    engine.engine.cache_clear()


@pytest.mark.usefixtures("short_parts")
@pytest.mark.parametrize("every", [1, 5])
def test_parts_of_checkpoints(every):
    """Parts of saved nodes; and of the steps between them."""
    assert_agree(gradient("kicks", every, "checkpoint"), gradient("kicks", every, "stored"), 1e-11)


@pytest.mark.full
@pytest.mark.usefixtures("short_parts")
def test_parts_of_checkpoints_of_steps_that_are_solved():
    """Parts of the steps between."""
    cost, p_f = simple_cost("checkpoint")
    assert_agree(jax.jit(jax.grad(cost))(p_f), simple_gradient("stored")(p_f), 1e-11)


def memory(adjoint: str, steps: int, every: int) -> float:
    """Bytes that the program of a gradient needs besides what goes in and out."""
    cost, at = cost_of(CHAIN, vm.fully_explicit(2), 0.02, steps, vm.Save(every, adjoint=adjoint))
    analysis = jax.jit(jax.grad(cost)).lower(*at).compile().memory_analysis()
    assert analysis is not None
    return analysis.temp_size_in_bytes


def test_memory_of_long_gradients():
    """From 10^3 stored states to 10^6 steps in a thousand parts: about twice the states."""
    checkpoint = [memory("checkpoint", steps, steps) for steps in (1000, 1_000_000)]
    assert checkpoint[1] < 4 * checkpoint[0]


@pytest.mark.full
def test_where_masses_fail_exact_matrices_are_differentiated():
    """With steps that passes with masses do not solve."""
    problem = PROBLEMS["tsp"]()
    found = {}
    for name in ("stored", "checkpoint"):
        cost, at = cost_of(problem, vm.fully_implicit(1), 0.3, 4, vm.Save(2, adjoint=name))
        found[name] = jax.jit(jax.grad(cost))(*at)
    run = vm.simulate(problem, vm.fully_implicit(1), macro_dt=0.3, num_steps=4)
    assert max(run.info.method) == vm.Method.EXACT
    for a, b in zip(*map(jax.tree.leaves, found.values()), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6)


# --- lanes, second derivatives, the choice of auto --------------------------------------------------------------------
def test_lanes_of_gradients():
    steps = "kicks"
    cost, at = simple_cost("checkpoint", steps)
    starts = jnp.stack([at, 1.1 * at])
    lanes = jax.jit(jax.vmap(jax.grad(cost)))(starts)
    np.testing.assert_allclose(lanes[1], simple_gradient("stored", steps)(starts[1]), rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize(("second", "compiled"), [(jax.jacfwd, False), (jax.jacrev, True)])
def test_second_derivatives_are_refused(second, compiled):
    cost, at = simple_cost("checkpoint")
    gradient = jax.grad(cost)
    with pytest.raises(TypeError, match="stored"):
        jax.eval_shape(second(jax.jit(gradient) if compiled else gradient), at)


def test_stored_steps_have_second_derivatives():
    """Reverse over reverse; `tests/verification/test_gradients.py` takes forward over reverse."""
    gradient, at = simple_gradient("stored"), simple_cost("stored")[1]
    h = 1e-5
    expected = jnp.stack([(gradient(at + h * e) - gradient(at - h * e)) / (2 * h) for e in jnp.eye(at.size)])
    np.testing.assert_allclose(jax.jit(jax.jacrev(gradient))(at), expected, rtol=1e-6, atol=1e-8)


def test_what_auto_chooses(monkeypatch):
    """Values with the derivatives that `checkpoint` refuses tell which adjoint has been taken."""
    cost, at = simple_cost("auto")
    monkeypatch.setattr(simulation, "LONGEST_STORED_RUN", 5)
    np.testing.assert_allclose(jax.jit(jax.grad(cost))(at), simple_gradient("stored")(at), rtol=1e-11, atol=1e-12)
    with pytest.raises(TypeError, match="stored"):
        jax.eval_shape(jax.jacfwd(jax.grad(cost)), at)


@pytest.mark.parametrize("name", ["reversible", "forward"])
def test_adjoints_that_do_not_exist(name):
    with pytest.raises(ValueError, match=f"adjoint is '{name}'; it must be one of 'auto', 'stored', 'checkpoint'"):
        vm.Save(adjoint=name)

"""Gradients of systems with an empty part, and with respect to lengths, against finite differences; sound runs under
`jax_debug_nans`."""

from functools import partial
from importlib import import_module

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params

import vmri_jax as vm
from vmri_jax.mechanics.linearisation import linearise
from vmri_jax.running import engine, loops


def fast_spring(q_f, params):
    return params * q_f @ q_f / 2


def weight(q_s, q_f, params):
    return params[0] * q_f[1]


def rod(q_s, q_f, params):
    return jnp.stack([q_f @ q_f - params[1] ** 2])


def bead(q_s, q_f, v_s, v_f, params):
    """On a parabola of the curvature `params`."""
    return (1 + params**2 * q_f[0] ** 2) * v_f[0] ** 2 / 2


def on_a_rod(gravity, length):
    return vm.System(vm.ConstantMass([], [1.0, 1.0]), weight, constraint=rod, params=jnp.stack([gravity, length]))


ONE = np.ones(())
SLOW = vm.System(vm.ConstantMass([1.0], []), lambda q_s, q_f, params: params * q_s @ q_s / 2)
FAST = vm.System(vm.ConstantMass([], [1.0]), fast_potential=fast_spring)
CASES = {  # system, positions, scheme
    "no fast part": (SLOW, ([1.0], []), vm.fully_explicit(1)),
    "no slow part": (FAST, ([], [1.0]), vm.fully_explicit(1)),
    "solved": (SLOW, ([1.0], []), vm.fully_implicit(1)),
    "T(q, v)": (vm.System(bead, fast_potential=fast_spring), ([], [0.5]), vm.fully_implicit(1)),
}
MASSES = vm.Solver("masses")
ONE_MATRIX = ("T(q, v)",)
"""Case without the exact solve behind their steps, which takes long to compile; "solved" has it."""
STEPS = {"macro_dt": 0.1, "num_steps": 5}


@pytest.fixture(autouse=True)
def debug_nans(monkeypatch):
    """`jax_debug_nans`, which must not stop sound runs; and adjoints in parts in short runs."""
    monkeypatch.setattr(loops, "MOST_UNDIVIDED", 3)
    monkeypatch.setattr(loops, "MOST_STORED_NUMBERS", 0)
    engine.engine.cache_clear()  # programs without parts
    with jax.debug_nans(True):
        yield
    engine.engine.cache_clear()


def assert_derivative(program, step=1e-5, tolerance=1e-8):
    """Of a program with value and derivative, at one. Measured: 1e-11 to 1e-9."""
    difference = (program(ONE + step)[0] - program(ONE - step)[0]) / (2 * step)
    assert abs(difference) > 1e-2
    np.testing.assert_allclose(program(ONE)[1], difference, rtol=tolerance)


def last_position(system, start, scheme, solver=None):
    run = vm.simulate(system, scheme, start, solver=solver, **STEPS)
    return jnp.concatenate([run.q_s[-1], run.q_f[-1]])[0]


@pytest.mark.parametrize("name", CASES)
def test_gradients_of_small_systems(name):
    system, (q_s, q_f), scheme = CASES[name]
    start, solver = vm.Problem(system.replace(params=ONE), q_s, q_f).state(), MASSES if name in ONE_MATRIX else None

    def position(k):
        return last_position(system.replace(params=k), start, scheme, solver)

    assert_derivative(jax.jit(jax.value_and_grad(position)))


def test_gradient_with_respect_to_the_length_of_a_rod():
    """The start stays, and the first step moves it onto the constraint; or `project` does so at the start."""

    def rod_of(length, project=False):
        return vm.Problem(on_a_rod(9.81 * ONE, length), [], [0.6, -0.8], project=project)

    def position(length):
        return last_position(rod_of(length), None, vm.fully_explicit(1), solver=MASSES)

    def projected(length):
        return rod_of(length, project=True).state().q_f[0]

    for function in (position, projected):
        # 1e-7: a start that stays may violate the constraint by 1e-6
        assert_derivative(jax.jit(jax.value_and_grad(function)), step=1e-7, tolerance=1e-6)


def test_derivatives_outside_of_jit():
    """There the numbers that derivatives keep are outputs of programs, which `jax_debug_nans` looks at."""
    system, start = on_a_rod(9.81 * ONE, ONE), vm.Problem(on_a_rod(9.81 * ONE, ONE), [], [0.6, -0.8]).state()

    def last(k):
        return last_position(system.replace(params=jnp.stack([k, ONE])), start, vm.fully_explicit(1), solver=MASSES)

    np.testing.assert_allclose(jax.grad(last)(ONE), jax.jacfwd(last)(ONE), rtol=1e-12)


def test_prepared_runs_and_batches():
    problem, scheme = vm.Problem(on_a_rod(9.81 * ONE, ONE), [], [0.6, -0.8]), vm.fully_explicit(1)
    prepared = vm.prepare(problem, scheme, save=vm.Save(micro=True), **STEPS)()
    starts = jax.tree.map(lambda a: np.stack([a, a]), problem.state())
    batch = vm.simulate_batch(problem.system, scheme, starts, **STEPS)
    np.testing.assert_allclose(batch.q_f[1], prepared.q_f, atol=1e-14)


def empty_slices(jaxpr):
    """Operations that take an empty slice of a concatenation, in a program and its parts."""
    axis_of = {eqn.outvars[0]: eqn.params["dimension"] for eqn in jaxpr.eqns if eqn.primitive.name == "concatenate"}
    for eqn in jaxpr.eqns:
        if eqn.primitive.name in ("slice", "split") and eqn.invars[0] in axis_of:
            yield from [eqn] * any(output.aval.shape[axis_of[eqn.invars[0]]] == 0 for output in eqn.outvars)
        for part in jaxprs_in_params(eqn.params):
            yield from empty_slices(part)


def on_a_line(q_s, q_f, params):
    return q_f[:1] + params * q_f[1:] - 1


HELD = vm.System(vm.ConstantMass([], [1.0, 1.0]), fast_potential=fast_spring, constraint=on_a_line)


@pytest.mark.parametrize(
    ("system", "start", "scheme"),
    [CASES["no fast part"], CASES["T(q, v)"], (HELD, ([], [0.6, 0.4]), vm.fully_explicit(2))],
)
def test_programs_take_no_empty_slice_of_a_concatenation(system, start, scheme):
    """On a single core XLA compiles such programs wrongly: calls of LAPACK without an implementation."""
    system = system.replace(params=ONE)
    state = vm.Problem(system, *start).state()

    def run(state):
        run = vm.simulate(system, scheme, state, **STEPS)
        return run.q_s, run.q_f, run.energy

    at_rest = linearise(system, state)
    step_matrices = import_module("vmri_jax.stability.multipliers")._step_matrices
    derivative = partial(step_matrices, system, scheme, at_rest.rest, at_rest.embed, at_rest.read)
    for program, argument in ((run, state), (derivative, np.ones(1))):
        assert not list(empty_slices(jax.make_jaxpr(program)(argument).jaxpr))

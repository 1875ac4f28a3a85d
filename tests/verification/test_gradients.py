# pyright: reportCallIssue=false
"""Derivatives of a final position, by the implicit function theorem at each step, against central differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.support import PROBLEMS, without_fallback
from vmri_jax import Newton, State, fully_explicit, fully_implicit, galerkin, initial_state, simulate

CASES = {
    "fpu, fully implicit": ("fpu", fully_implicit(4), 0.05, "omega", None),
    "fpu, fully explicit": ("fpu", fully_explicit(4), 0.05, "omega", None),
    "fpu, gauss 2": ("fpu", galerkin(2, 2), 0.05, "omega", None),
    "tsp, fully implicit": ("tsp", fully_implicit(3), 0.02, "stiffness", None),
    "sam, fully implicit": ("sam", fully_implicit(2), 0.02, "stiffness", 2),
}


def final_position(name, scheme, macro_dt, parameter, entry, newton):
    """A function of one stiffness: the sum of cosines of the fast positions after 10 steps; by the march alone without `newton`."""
    problem = PROBLEMS[name]()
    state, newton = problem.state(), newton or without_fallback(problem.system, scheme)

    def function(stiffness) -> jax.Array:
        value = problem.system.params[parameter]
        value = stiffness if entry is None else value.at[entry].set(stiffness)
        system = problem.system.replace(params=problem.system.params | {parameter: value})
        run = simulate(system, scheme, state, macro_dt=macro_dt, num_steps=10, save_every=5, newton=newton)
        return jnp.sum(jnp.cos(run.q_f[-1] * jnp.arange(1, run.q_f.shape[1] + 1)))

    value = problem.system.params[parameter]
    return function, float(value if entry is None else value[entry])


def central_difference(function, x, step):
    """Richardson-extrapolated central difference, error O(step^4)."""
    d = [(function(x + h) - function(x - h)) / (2 * h) for h in (step, step / 2)]
    return float((4 * d[1] - d[0]) / 3)


@pytest.mark.parametrize("case", CASES)
def test_gradient_with_respect_to_a_stiffness(case):
    function, x = final_position(*CASES[case], Newton() if case == "fpu, fully implicit" else None)
    function = jax.jit(function)
    expected = central_difference(function, x, 1e-3 * x)
    reverse = float(jax.jit(jax.grad(function))(x))
    assert abs(expected) > 1e-9
    assert reverse == pytest.approx(expected, rel=2e-7)  # measured 1.6e-8, 1e-6 wanted


def test_forward_reverse_and_both_methods_agree():
    values = []
    for solver in ("arrowhead", "dense"):
        function, x = final_position(*CASES["tsp, fully implicit"], Newton(method=solver))
        values += [float(jax.jit(jax.jacfwd(function))(x)), float(jax.jit(jax.grad(function))(x))]
    assert np.allclose(values, values[0], rtol=1e-9, atol=0)


def test_gradient_with_respect_to_the_initial_state(tsp):
    """Initial velocities, through the projection of the momenta onto the constraints."""

    scheme = fully_implicit(2)
    newton = without_fallback(tsp.system, scheme)

    @jax.jit
    def height(v):
        state = initial_state(tsp.system, tsp.q_s, tsp.q_f, v[:3], v[3:])
        return simulate(tsp.system, scheme, state, macro_dt=0.02, num_steps=5, newton=newton).q_f[-1, 5]

    v = jnp.concatenate([tsp.v_s, tsp.v_f])
    gradient = jax.jit(jax.grad(height))(v)
    expected = [central_difference(lambda x, i=i: height(v.at[i].set(x)), v[i], 1e-2) for i in range(9)]
    assert np.abs(expected).max() > 0.01
    assert np.allclose(gradient, expected, rtol=1e-6, atol=1e-9)


def test_gradient_with_respect_to_a_state_and_the_step(fpu):
    start, scheme = fpu.state(), fully_implicit(2)
    newton = without_fallback(fpu.system, scheme)

    @jax.jit
    def end(q_f, macro_dt):
        state = State(start.t, start.q_s, q_f, start.p_s, start.p_f)
        return simulate(fpu.system, scheme, state, macro_dt=macro_dt, num_steps=5, newton=newton).q_f[-1, 0]

    gradient, by_step = jax.jit(jax.grad(end, argnums=(0, 1)))(start.q_f, 0.05)
    expected = [
        central_difference(lambda x, i=i: end(start.q_f.at[i].set(x), 0.05), start.q_f[i], 1e-3) for i in range(3)
    ]
    assert np.allclose(gradient, expected, rtol=1e-6, atol=1e-9)
    assert float(by_step) == pytest.approx(central_difference(lambda x: end(start.q_f, x), 0.05, 1e-3), rel=1e-5)


@pytest.mark.parametrize("hessian", [jax.hessian, lambda f: jax.jacfwd(jax.jacfwd(f))], ids=["over reverse", "forward"])
def test_second_derivative(fpu, hessian):
    scheme = fully_implicit(2)
    newton = without_fallback(fpu.system, scheme)

    def end(omega):
        system, steps = fpu.system.replace(params={"omega": omega}), {"macro_dt": 0.1, "num_steps": 3, "save_every": 3}
        return simulate(system, scheme, fpu.state(), **steps, newton=newton).q_f[-1, 0]

    slope, step = jax.jit(jax.grad(end)), 1e-3
    difference = float(slope(50.0 + step) - slope(50.0 - step)) / (2 * step)
    assert float(jax.jit(hessian(end))(50.0)) == pytest.approx(difference, rel=1e-6)  # measured 2e-9

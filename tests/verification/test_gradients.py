# pyright: reportCallIssue=false
"""Derivatives of a final position, by the implicit function theorem at each step, against central differences.

`tests/running/test_parts.py` has them with the exact solve behind the steps in the program.
"""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.support import PROBLEMS, without_fallback
from tests.user_systems import cart

CHAIN = vm.systems.fermi_pasta_ulam(1)
CASES = {  # problem, scheme, macro_dt, name and entry of the parameter
    "chain, fully implicit": (CHAIN, vm.fully_implicit(2), 0.05, "omega", None),
    "chain, gauss 2": (CHAIN, vm.galerkin(2, 2), 0.05, "omega", None),
    "cart, fully implicit": (cart(), vm.fully_implicit(2), 0.1, None, None),
    "fpu, fully implicit": (PROBLEMS["fpu"](), vm.fully_implicit(4), 0.05, "omega", None),
    "tsp, fully implicit": (PROBLEMS["tsp"](), vm.fully_implicit(3), 0.02, "stiffness", None),
    "sam, fully implicit": (PROBLEMS["sam"](), vm.fully_implicit(2), 0.02, "stiffness", 2),
}
LONG = ("chain, fully implicit", "fpu, fully implicit", "tsp, fully implicit", "sam, fully implicit")


def central_difference(function, x, step):
    """Richardson-extrapolated central difference, error O(step^4)."""
    d = [(function(x + h) - function(x - h)) / (2 * h) for h in (step, step / 2)]
    return float((4 * d[1] - d[0]) / 3)


@cache
def gradient_program(case: str):
    """Value and gradient of the sum of cosines of the fast positions after 10 steps by
    ``(stiffness, v, q_f, macro_dt)``, compiled; and the arguments of the case. The start has the velocities v,
    projected onto the constraints, and the fast positions q_f."""
    problem, scheme, macro_dt, parameter, entry = CASES[case]
    params, n_s = problem.system.params, problem.q_s.size
    solver = without_fallback(problem, scheme)

    def replaced(stiffness):
        if parameter is None:
            return stiffness
        return params | {
            parameter: stiffness if entry is None else jnp.asarray(params[parameter]).at[entry].set(stiffness)
        }

    def function(stiffness, v, q_f, macro_dt) -> jax.Array:
        system = problem.system.replace(params=replaced(stiffness))
        project = problem.system.is_constrained
        state = vm.initial_state(problem.system, problem.q_s, problem.q_f, v[:n_s], v[n_s:], project=project)
        state = vm.State(state.t, state.q_s, q_f, state.p_s, state.p_f)
        run = vm.simulate(system, scheme, state, macro_dt=macro_dt, num_steps=10, save=5, solver=solver)
        return jnp.sum(jnp.cos(run.q_f[-1] * jnp.arange(1, run.q_f.shape[1] + 1)))

    stiffness = params if parameter is None else params[parameter]
    velocities = np.concatenate([problem.v_s, problem.v_f])
    at = stiffness if entry is None else stiffness[entry], velocities, problem.q_f, macro_dt
    return jax.jit(jax.value_and_grad(function, argnums=(0, 1, 2, 3))), tuple(np.asarray(x, float) for x in at)


def value_by_argument(case: str, argument: int, entry: int | None = None):
    """The value as a function of one argument, or of one of its entries, alone."""
    program, at = gradient_program(case)

    def function(x):
        value = np.array(at[argument])
        value[... if entry is None else entry] = x
        return program(*at[:argument], value, *at[argument + 1 :])[0]

    return function


@pytest.mark.parametrize("case", [pytest.param(c, marks=pytest.mark.full if c in LONG else ()) for c in CASES])
def test_gradient_with_respect_to_a_stiffness(case):
    program, at = gradient_program(case)
    expected = central_difference(value_by_argument(case, 0), at[0], 1e-3 * at[0])
    assert abs(expected) > 1e-9
    assert float(program(*at)[1][0]) == pytest.approx(expected, rel=2e-7)  # measured 1.6e-8, 1e-6 wanted


def test_gradient_with_respect_to_the_start_and_the_step():
    """Velocities go through the projection of the momenta onto the constraints."""
    case = "cart, fully implicit"
    program, at = gradient_program(case)
    expected = [central_difference(value_by_argument(case, 1, i), at[1][i], 1e-2) for i in range(3)]
    assert np.abs(expected).max() > 0.01
    assert np.allclose(program(*at)[1][1], expected, rtol=1e-6, atol=1e-9)
    case = "chain, gauss 2"
    program, at = gradient_program(case)
    _, _, by_position, by_step = program(*at)[1]
    expected = [central_difference(value_by_argument(case, 2, i), at[2][i], 1e-3) for i in range(at[2].size)]
    assert np.allclose(by_position, expected, rtol=1e-6, atol=1e-9)
    assert float(by_step) == pytest.approx(central_difference(value_by_argument(case, 3), at[3], 1e-4), rel=1e-5)


def position_after_a_step(case: str, matrix: str):
    """The sum of fast positions after one macro step, by a matrix, as a function of the stiffness; and the stiffness of
    the case."""
    problem, scheme, macro_dt, parameter, _ = CASES[case]

    def function(stiffness):
        system = problem.system.replace(params={parameter: stiffness} if parameter else stiffness)
        end, _ = vm.macro_step(system, scheme, problem.state(), macro_dt, vm.Solver(matrix))
        return jnp.sum(jnp.cos(end.q_f * jnp.arange(1, end.q_f.size + 1)))

    params = problem.system.params
    return function, jnp.asarray(params[parameter] if parameter else params, float)


def test_exact_matrices_have_the_same_derivative():
    """The derivative through all unknowns at once, under a constraint."""
    function, at = position_after_a_step("cart, fully implicit", "exact")
    program = jax.jit(jax.value_and_grad(function))
    expected = central_difference(lambda x: program(x)[0], at, 1e-2 * at)
    assert float(program(at)[1]) == pytest.approx(expected, rel=1e-6)


@pytest.mark.full
def test_second_derivative():
    """Forward over forward, of a step; `tests/running/test_adjoints.py` has second derivatives of runs, over
    reverse."""
    function, at = position_after_a_step("chain, fully implicit", "masses")
    slope, step = jax.jit(jax.jacfwd(function)), 1e-3
    difference = (slope(at + step) - slope(at - step)) / (2 * step)
    assert float(jax.jit(jax.jacfwd(jax.jacfwd(function)))(at)) == pytest.approx(float(difference), rel=1e-6)


def stiffness_times_square(q_f, params):
    return params["omega"] ** 2 / 2 * jnp.sum(q_f**2) + jnp.sum(q_f**4)


def test_a_third_derivative_is_no_number():
    """It would be wrong where equations are solved; where nothing is solved it is that of the polynomial through the
    values."""
    system = vm.System(vm.ConstantMass([], [1.0]), None, stiffness_times_square, params={"omega": 30.0})
    state = vm.initial_state(system, [], [1.0], [], [0.5])

    def position(stiffness, scheme):
        moving = system.replace(params={"omega": stiffness})
        end, _ = vm.macro_step(moving, scheme, state, 0.05, without_fallback(system, scheme, state))
        return jnp.cos(end.q_f[0])

    def third(scheme):
        return float(jax.jit(jax.jacfwd(jax.jacfwd(jax.grad(partial(position, scheme=scheme)))))(30.0))

    assert np.isnan(third(vm.fully_implicit(1)))
    value = np.vectorize(jax.jit(partial(position, scheme=vm.fully_explicit(1))))
    polynomial = np.polynomial.Chebyshev.interpolate(value, 14, [28.0, 32.0])
    assert third(vm.fully_explicit(1)) == pytest.approx(polynomial.deriv(3)(30.0), rel=1e-6)

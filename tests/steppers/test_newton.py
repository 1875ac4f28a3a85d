"""Newton's iteration: how it ends, and how many iterations hard steps take."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.support import compiled_step, largest_difference, until_failure
from vmri_jax import kernels
from vmri_jax.steppers.marched import PLAIN_PASSES
from vmri_jax.steppers.solver import Solver

EXACT = Solver("exact")


def step(problem, scheme, macro_dt, solver=EXACT, state=None):
    state = problem.state() if state is None else state
    state, info = compiled_step(problem.system, scheme, state, macro_dt, solver)
    return state, info, vm.Result(int(info.result))


def test_a_plain_step_converges(fpu):
    _, info, result = step(fpu, vm.fully_implicit(20), 0.05)
    assert result is vm.Result.CONVERGED
    assert result.success
    assert 1 <= int(info.iterations) <= 4
    assert float(info.residual) < 1e-13
    start = fpu.state()
    bad = vm.State(start.t, start.q_s, start.q_f * np.nan, start.p_s, start.p_f)
    assert step(fpu, vm.fully_implicit(20), 0.05, state=bad)[2] is vm.Result.NON_FINITE


def test_too_few_iterations_stagnate(fpu):
    _, info, result = step(fpu, vm.fully_implicit(20), 0.05, Solver("exact", max_iterations=1))
    assert result is vm.Result.STAGNATED
    assert not result.success
    assert int(info.iterations) == 1
    assert "max_iterations" in result.message


def test_a_tolerance_below_roundoff_ends_at_the_floor(fpu):
    _, info, result = step(fpu, vm.fully_implicit(20), 0.05, Solver("exact", tolerance=1e-30))
    assert result is vm.Result.CONVERGED_AT_ROUNDOFF or result is vm.Result.CONVERGED
    assert int(info.iterations) < 10
    assert float(info.residual) < 1e-13


@pytest.mark.parametrize(("macro_dt", "most"), [(0.01, 7), (0.05, 9)])
def test_iterations_of_the_pendulum(tsp, macro_dt, most):
    state = tsp.state()
    for _ in range(2):
        run = vm.simulate(tsp.system, vm.fully_implicit(10), state, macro_dt=macro_dt, num_steps=60, solver=EXACT)
        assert int(run.info.iterations.max()) <= most
        state = run.final_state


def test_iterations_of_a_large_macro_step(fpu):
    run = vm.simulate(fpu.system, vm.fully_implicit(100), fpu.state(), macro_dt=1.0, num_steps=20, solver=EXACT)
    assert int(run.info.iterations.max()) <= 14  # measured 12


def test_a_looser_tolerance_needs_fewer_iterations_and_is_as_accurate_as_asked(fpu):
    scheme = vm.fully_implicit(20)
    exact, info, _ = step(fpu, scheme, 0.5)
    loose, loose_info, result = step(fpu, scheme, 0.5, Solver("exact", tolerance=1e-4))
    assert result is vm.Result.CONVERGED
    assert int(loose_info.iterations) < int(info.iterations)
    assert 1e-15 < largest_difference(loose.q_s, exact.q_s) < 1e-4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"tolerance": 0.0}, "tolerance is 0.0; it must be positive"),
        ({"tolerance": "small"}, "tolerance is 'small'; give a real number"),
        ({"max_iterations": 0}, "max_iterations is 0; it must be positive"),
        ({"max_iterations": None}, "max_iterations"),
        ({"matrix": "sparse"}, "matrix is 'sparse'; it must be one of auto, masses, modes, exact, null_space"),
        ({"matrix": "exact", "stepper": print}, "matrix is 'exact' beside a stepper"),
    ],
)
def test_bad_options_are_refused(arguments, message):
    with pytest.raises(vm.Refused, match=message):
        Solver(**arguments)


def test_every_status_has_a_message():
    assert all(len(result.message) > 40 and result.message.endswith(".") for result in vm.Result)
    assert [result.success for result in vm.Result] == [True, True] + [False] * (len(vm.Result) - 2)


def test_huge_steps_end_at_the_solution_that_is_meant(tsp):
    """Plain Newton from straight motion ends at another solution in one of these steps, of 70 times the energy."""
    run = vm.simulate(tsp.system, vm.fully_implicit(10), tsp.state(), macro_dt=0.2, num_steps=60, solver=EXACT)
    assert float(jnp.abs(run.energy - run.energy[0]).max()) < 200.0  # measured 145, of 12 000 that are exchanged
    assert float(run.constraint_residual.max()) < 1e-11


def test_continuation_finds_the_solution_that_plain_newton_misses(tsp):
    """The whole step, from what the steps before lead to and from straight motion, has no solution that passes find.

    The motion is chaotic, so that round-off decides which start meets such a step: of 64 starts 34 end, and most of
    these need continuation.
    """
    state, ended = tsp.state(), []
    for k in range(16):
        start = replace(state, p_s=(1 + 1e-3 * k) * state.p_s, p_f=(1 + 1e-3 * k) * state.p_f)
        run = until_failure(tsp.system, vm.fully_implicit(10), start, macro_dt=0.4, num_steps=40, solver=EXACT)
        ended += [run] if run.success else []
    assert len(ended) >= 6  # measured 10 and 11
    if kernels.CONTRACTION > 0:  # with exact matrices in every pass nothing is missed
        assert max(run.info.iterations.max() for run in ended) > PLAIN_PASSES
    # measured 601, of 12 000 that are exchanged
    assert max(np.abs(run.energy - run.energy[0]).max() for run in ended) < 800.0
    assert max(run.constraint_residual.max() for run in ended) < 1e-11


def on_two_circles(q_s, q_f, params):
    return jnp.stack([q_f @ q_f - 1.0, q_f @ q_f - 1.2])


def hill(q_f, params):
    return -params / 2 * jnp.sum(q_f**2)


def test_contradicting_constraints_are_violated():
    system = vm.System(vm.ConstantMass([1.0], [1.0, 1.0]), constraint=on_two_circles)
    one, zero = np.ones(1), np.zeros(1)
    state = vm.State(np.zeros(()), zero, np.array([1.0, 0.0]), one, np.array([0.0, 0.5]))
    _, info = compiled_step(system, vm.fully_implicit(2), state, 0.1, EXACT)
    assert vm.Result(int(info.result)) is vm.Result.CONSTRAINT_VIOLATED


def test_a_curvature_that_cancels_the_mass_is_singular():
    """``m - h^2 k / 4 = 0`` for the midpoint rule on a hill of curvature k."""
    system = vm.System(vm.ConstantMass([1.0], [1.0]), fast_potential=hill, params=np.array(4.0))
    state = vm.initial_state(system, [0.0], [0.3], [0.0], [0.1])
    _, info = compiled_step(system, vm.fully_implicit(1), state, 1.0, EXACT)
    assert vm.Result(int(info.result)) is vm.Result.SINGULAR


def pair(q_s, q_f, params):
    return jnp.sum((q_f - q_s) ** 4) / 2


def test_slow_variable_that_only_sees_round_off():
    """A symmetric pair leaves its centre at rest but for round-off: no size of its own to converge relative to."""
    system = vm.System(vm.ConstantMass([1.0], [1.0, 1.0]), pair, lambda q_f, params: 50 * jnp.sum(q_f**2))
    state = vm.initial_state(system, [0.0], [0.3, -0.3], [0.0], [0.0, 0.0])
    run = vm.simulate(system, vm.fully_implicit(4), state, macro_dt=0.1, num_steps=200, solver=EXACT)
    assert int(run.info.iterations.max()) <= 4
    assert float(jnp.abs(run.q_s).max()) < 1e-15  # measured 1e-17


def test_round_off_of_coupled_masses_ends_the_iteration():
    """Masses of condition number 1e8, like the masses of a chain of a hundred bars: corrections stay at 1e-10 of the
    increments."""
    lever = np.tril(np.ones((60, 60))).T @ np.tril(np.ones((60, 60)))
    masses = lever.T @ lever

    def kinetic(q_s, q_f, v_s, v_f, params):
        return v_f @ (masses * (1 + jnp.sum(q_f) ** 2)) @ v_f / 2

    def weight(q_f, params):
        return 9.81 * jnp.sum(masses[0] * q_f)

    problem = vm.Problem(vm.System(kinetic, fast_potential=weight), q_s=[], q_f=np.zeros(60))
    run = vm.simulate(problem, vm.fully_implicit(1), macro_dt=1e-3, num_steps=3)
    assert np.max(run.info.residual) < 1e-14

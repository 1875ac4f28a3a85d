"""The nested iteration: few passes, errors within the tolerance, honest about what it did. Its steps are held to the
textbook in `tests/textbook`, and those of the reference problems to trajectories of another program in
`tests/verification`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.stability.systems import swinging
from tests.support import largest_difference
from tests.user_systems import double_pendulum, two_oscillators
from vmri_jax.steppers.solver import Solver


def ends_differ(a, b) -> float:
    """Largest relative difference of two final states."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return max(largest_difference(x, y) / (1e-300 + float(np.abs(y).max(initial=0))) for x, y in pairs if x.size)


def positions(run):
    return np.concatenate([run.q_s, run.q_f], axis=1)


@pytest.mark.parametrize(
    ("name", "scheme", "macro_dt", "passes"),
    [
        ("fpu", vm.galerkin(4, 2), 0.1, 6),  # measured 5.1
        ("fpu", vm.explicit_slow(4), 0.04, 2),
        ("tsp", vm.fully_explicit(10), 0.02, 4.2),
        ("pendulum", vm.explicit_slow(5), 0.01, 6.5),  # measured 5.9
        pytest.param("sam", vm.explicit_slow(5), 0.01, 5.5, marks=pytest.mark.full),  # measured 5.0
        pytest.param("sam", vm.galerkin(2, 2), 0.002, 9, marks=pytest.mark.full),
    ],
)
def test_few_passes_and_errors_within_the_tolerance(name, scheme, macro_dt, passes, request):
    problem = swinging() if name == "pendulum" else request.getfixturevalue(name)

    def run(solver):
        return vm.simulate(problem.system, scheme, problem.state(), macro_dt=macro_dt, num_steps=20, solver=solver)

    exact = run(Solver("masses"))
    assert exact.info.iterations.mean() < passes, exact.info.iterations.mean()
    motion = np.abs(np.diff(positions(exact), axis=0)).max()
    for tolerance in (1e-3, 1e-9):
        error = np.abs(positions(run(Solver("masses", tolerance))) - positions(exact)).max()
        assert error < tolerance * motion  # measured at most 0.14 of it


def test_few_passes_where_the_slow_motion_is_smooth(tsp):
    """Were the slow increments to start from their last values, the passes would be 3.7."""
    for scheme, micro_dt, num_steps, passes in (
        (vm.fully_explicit(10), 2e-4, 500, 2.4),  # measured 2.2
        (vm.fully_implicit(10), 2e-4, 1000, 2.7),  # measured 2.5
    ):
        how = {"macro_dt": 10 * micro_dt, "num_steps": num_steps, "solver": Solver("masses")}
        run = vm.simulate(tsp.system, scheme, tsp.state(), **how)
        assert run.info.iterations.mean() < passes


def test_few_passes_where_the_motion_of_one_interval_is_smooth():
    """Were the unknowns to start from their last values, the passes would be 4.6."""
    run = vm.simulate(double_pendulum(), vm.fully_implicit(1), macro_dt=1e-3, num_steps=300)
    assert run.info.iterations.mean() < 2  # measured 1.5


def test_light_slow_bodies_that_constraints_tie_to_fast_ones():
    """Were the slow equations solved with the slow masses alone, no step would converge."""
    problem = vm.systems.triple_spherical_pendulum(masses=(1.0, 1.0, 1.0))
    how = {"macro_dt": 0.01, "num_steps": 300, "solver": Solver("masses")}
    run = vm.simulate(problem.system, vm.fully_explicit(10), problem.state(), **how)
    assert run.info.iterations.mean() < 6  # measured 5.5


@pytest.mark.parametrize("scheme", [vm.fully_explicit(1), vm.explicit_slow(5)])
def test_a_heavy_slow_body_at_rest_at_the_origin(scheme):
    """It has neither position nor motion to be relative to: round-off of the hook on its rope is all there is."""

    def weight(q_s, q_f, params):
        return 9.81 * q_f[1]

    def rope(q_s, q_f, params):
        return jnp.array([((q_f[0] - q_s[0]) ** 2 + q_f[1] ** 2 - 25.0) / 2])

    system = vm.System(vm.ConstantMass([500.0], [1.0, 1.0]), weight, None, rope)
    crane = vm.Problem(system, q_s=[0.0], q_f=[3.0, -4.0])
    run = vm.simulate(crane, scheme, macro_dt=4e-4, num_steps=20)
    assert int(run.info.method.max()) <= vm.Method.MASSES
    assert int(run.info.iterations.max()) <= 20  # without it: a hundred, and the fallback
    momentum = 500.0 * run.v_s[:, 0] + run.v_f[:, 0]
    np.testing.assert_allclose(momentum, 0.0, atol=1e-12)


def hangs(q_s, q_f, params):
    return 10.0 * q_s[1] + (q_s[0] - q_f[0]) ** 2


def rod(q_s, params):
    return jnp.array([(q_s @ q_s - 1.0) / 2])


@pytest.mark.parametrize("matrix", ["masses", "exact"])
def test_the_first_pass_of_a_step_at_rest_has_its_slow_multipliers(matrix):
    pendulum = vm.Problem(vm.System(vm.ConstantMass([1.0, 1.0], [1.0]), hangs, slow_constraint=rod), [0.0, -1.0], [0.0])
    end, info = vm.macro_step(pendulum.system, vm.galerkin(2, 2), pendulum.state(), 0.1, Solver(matrix))
    np.testing.assert_allclose(
        info.slow_multiplier, 10.0, rtol=1e-12
    )  # they carry the weight; zero without a correction
    np.testing.assert_allclose(end.p_s, 0.0, atol=1e-14)


def test_macro_steps_in_which_slow_forces_turn_over():
    """At H = 1 what V answers is as large as the masses: by the masses alone the march does not converge."""
    problem = vm.systems.fermi_pasta_ulam(10)
    run = vm.simulate(
        problem.system, vm.fully_implicit(100), problem.state(), macro_dt=1.0, num_steps=20, solver=Solver("masses")
    )
    assert run.info.iterations.max() < 16  # measured 10


def test_forces_on_slow_variables_cost_few_passes():
    """Potential and damping: by the masses alone it would be 77."""
    problem = two_oscillators()
    system = problem.system.replace(force=lambda t, q_s, q_f, v_s, v_f, params: (-5.0 * v_s, 0.0 * v_f))
    how = {"macro_dt": 0.2, "num_steps": 20, "solver": Solver("masses")}
    run = vm.simulate(system, vm.fully_implicit(20), problem.state(), **how)
    assert run.info.iterations.mean() < 7.5  # measured 6.3


def test_equal_masses_converge():
    """Fast and slow parts of one weight: nothing is weak about the coupling."""
    problem = vm.systems.triple_spherical_pendulum(masses=(1.0, 1.0, 1.0), stiffness=50.0)
    how = {"macro_dt": 0.1, "num_steps": 50, "solver": Solver("masses")}
    run = vm.simulate(problem.system, vm.fully_implicit(10), problem.state(), **how)
    passes = run.info.iterations
    assert passes.mean() < 13  # measured 11
    assert passes.max() < 25  # measured 22


def test_momenta_have_their_full_precision(tsp):
    """The heavy slow bob turns round-off of positions into impulses on the light ones, unless momenta are sums of
    impulses. Measured over 300 steps: 4e-14; 3e-13 with momenta from the increments of the last correction."""

    def end(solver):
        return vm.simulate(tsp, vm.fully_explicit(1), macro_dt=0.002, num_steps=300, save=100, solver=solver)[-1]

    drift = end(Solver())
    assert ends_differ(end(Solver("exact")), drift) < 1e-13

"""Corrected kicks: frequencies of harmonic vibrations of order 4 on both grids, the same step by every method, and what
they refuse."""

import jax
import numpy as np
import pytest

import vmri_jax as vm
from tests.support import ground_truth, largest_difference, step_matrix
from tests.user_systems import cart, double_pendulum, two_oscillators
from vmri_jax.schemes.quadrature import gradient_corrected, midpoint, trapezoidal

KAPPA, OMEGA = 25.0, 50.0


def frequency_errors(scheme: vm.Scheme, macro_dt: float) -> np.ndarray:
    stiffness = np.array([[KAPPA, -KAPPA], [-KAPPA, KAPPA + OMEGA**2]])
    exact = np.sqrt(np.linalg.eigvalsh(stiffness))
    matrix = step_matrix(two_oscillators(KAPPA, OMEGA).system, scheme, macro_dt)
    phases = np.angle(np.linalg.eigvals(np.asarray(matrix)))
    return np.abs(np.sort(phases[phases > 0]) / macro_dt - exact)


@pytest.mark.parametrize("num_micro", [1, 5])
def test_frequencies_are_of_order_four(num_micro):
    coarse, fine = (frequency_errors(vm.takahashi_imada(num_micro), macro_dt) for macro_dt in (0.01, 0.005))
    assert np.log2(coarse / fine) == pytest.approx(4, abs=0.2)
    plain = frequency_errors(vm.fully_explicit(num_micro), 0.01)
    assert np.all(coarse < 0.02 * plain)


def test_the_limit_of_stability():
    """``|2 - x (1 - x / 12)| < 2`` for ``x = (omega h)^2`` below 12; the slow variable takes no part."""
    system = two_oscillators(0.0, 1.0).system

    def trace(scheme, h):
        matrix = step_matrix(system, scheme, h)
        return float(matrix[1, 1] + matrix[3, 3])

    for h in (1.0, 3.4, 3.5):
        assert trace(vm.takahashi_imada(1), h) == pytest.approx(2 - h**2 * (1 - h**2 / 12), abs=1e-12)
    assert abs(trace(vm.takahashi_imada(1), 3.4)) < 2 < abs(trace(vm.takahashi_imada(1), 3.5))
    assert abs(trace(vm.fully_explicit(1), 2.1)) > 2


def test_it_is_symplectic():
    matrix = np.asarray(step_matrix(two_oscillators(KAPPA, OMEGA).system, vm.takahashi_imada(3), 0.02))
    none, one = np.zeros((2, 2)), np.eye(2)
    form = np.block([[none, one], [-one, none]])
    np.testing.assert_allclose(matrix.T @ form @ matrix, form, atol=1e-13)


def test_in_coordinates_that_move_along_it_is_of_order_four(fpu):
    """``q - h^2/12 M^-1 grad U`` of nonlinear motion, with masses of one and a single grid."""

    @jax.jit
    def force(q):
        return jax.grad(
            lambda q: fpu.system.slow_potential(q[:3], q[3:], params) + fpu.system.fast_potential(q[3:], params)
        )(q)

    params, t_end, errors = fpu.system.params, 0.5, []
    q, v = np.concatenate([fpu.q_s, fpu.q_f]), np.concatenate([fpu.v_s, fpu.v_f])
    turning = np.asarray(jax.jit(lambda q, v: jax.jvp(force, (q,), (v,))[1])(q, v))
    exact = ground_truth("fpu3_t1")["q"][50]  # of 100 intervals up to time 1
    for steps in (80, 160):
        h = t_end / steps
        x, w = q + h**2 / 12 * np.asarray(force(q)), v - h**2 / 12 * turning
        start = vm.initial_state(fpu.system, x[:3], x[3:], w[:3], w[3:])
        run = vm.simulate(fpu.system, vm.takahashi_imada(1), start, macro_dt=h, num_steps=steps, save=steps)
        x = np.concatenate([run.q_s[-1], run.q_f[-1]])
        x = x - h**2 / 12 * np.asarray(force(x))
        errors.append(largest_difference(x, exact))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4, abs=0.25)


def test_composed_it_is_of_order_four(fpu):
    state, exact = fpu.state(), ground_truth("fpu3_t1")["q"][50]
    scheme, errors = vm.compose(vm.takahashi_imada(2), "suzuki4"), []
    for steps in (40, 80):
        run = vm.simulate(fpu.system, scheme, state, macro_dt=0.5 / steps, num_steps=steps, save=steps)
        errors.append(largest_difference(run.q_s[-1], exact[:3]))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4, abs=0.3)


def test_with_constraints_every_method_makes_the_same_step():
    """Masses take the correction as kicks between micro intervals, exact matrices as nodes of the macro interval."""
    problem = cart()
    system = problem.system.replace(fast_potential=lambda q_f, params: 400 * (q_f[1] + 0.5) ** 2)

    how = {"macro_dt": 0.02, "num_steps": 20}
    masses, exact = (
        vm.simulate(system, vm.takahashi_imada(3), problem.state(), solver=vm.Solver(matrix), **how)
        for matrix in ("masses", "exact")
    )
    assert largest_difference(masses.p_f, exact.p_f) < 1e-9
    assert masses.constraint_residual.max() < 1e-11


def test_with_constraints_vibrations_keep_their_phase(tsp):
    """Errors after 16 periods of the spring: several times smaller with as many steps."""
    exact = ground_truth("tsp_t1")["q"][-1, 3:]

    def error(scheme):
        run = vm.simulate(tsp.system, scheme, tsp.state(), macro_dt=1 / 200, num_steps=200, save=200)
        return largest_difference(run.q_f[-1], exact)

    assert error(vm.takahashi_imada(1)) < 0.1 * error(vm.fully_explicit(1))


def test_it_says_what_it_costs():
    plain, squared = vm.fully_explicit(8).describe(), vm.takahashi_imada(8).describe()
    assert (squared.slow_evaluations, squared.fast_evaluations) == (
        2 * plain.slow_evaluations,
        2 * plain.fast_evaluations + 1,
    )
    assert (squared.order, squared.symmetric, squared.solves) == (2, True, 0)


def test_it_refuses_what_has_no_correction():
    with pytest.raises(ValueError, match=r"gradient_corrected: got .*give kicks at the nodes of a grid"):
        gradient_corrected(vm.micro(midpoint))
    kicks = vm.micro(trapezoidal)
    with pytest.raises(ValueError, match="slow on the micro grid, degree 1, is corrected; only kicks"):
        vm.Scheme(2, kinetic=vm.micro(midpoint), slow=gradient_corrected(kicks), fast=kicks)
    with pytest.raises(ValueError, match="fast on the micro grid, degree 2, is corrected"):
        vm.Scheme(2, 2, kinetic=vm.micro(vm.quadrature.gauss(2)), slow=kicks, fast=gradient_corrected(kicks))
    arms = double_pendulum()
    with pytest.raises(ValueError, match="corrected kicks need a System whose kinetic is a ConstantMass"):
        vm.simulate(arms.system, vm.takahashi_imada(2), arms.state(), macro_dt=0.01, num_steps=1)

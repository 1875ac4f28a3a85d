"""Known methods as special cases, each written out in numpy: midpoint variational integrator, Verlet, RATTLE."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.support import largest_difference
from tests.user_systems import stiff_spring, two_oscillators
from vmri_jax import Scheme, explicit_slow, fully_explicit, fully_implicit, macro, micro, quadrature, simulate, systems

H, STEPS = 0.02, 25


def joined(run):
    return np.concatenate([run.q_s, run.q_f], axis=1), np.concatenate([run.p_s, run.p_f], axis=1)


def force_of(problem):
    """-dU/dq and its derivative, of all potentials together."""
    system, n_s = problem.system, problem.q_s.size

    def potential(q):
        return system.slow_potential(q[:n_s], q[n_s:], system.params) + system.fast_potential(q[n_s:], system.params)

    gradient, hessian = jax.jit(jax.grad(potential)), jax.jit(jax.hessian(potential))
    return lambda q: -np.asarray(gradient(q)), lambda q: -np.asarray(hessian(q))


def start_of(problem):
    state = problem.state()
    return np.concatenate([state.q_s, state.q_f]), np.concatenate([state.p_s, state.p_f])


def test_one_implicit_micro_step_is_the_midpoint_variational_integrator(fpu):
    run = simulate(fpu.system, fully_implicit(1), fpu.state(), macro_dt=H, num_steps=STEPS)
    force, slope = force_of(fpu)
    q, p = start_of(fpu)
    for k in range(STEPS):
        new = q + H * p
        for _ in range(8):  # p = (q+ - q) / H - H/2 F((q + q+) / 2), unit masses
            residual = (new - q) / H - H / 2 * force((q + new) / 2) - p
            new = new - np.linalg.solve(np.eye(6) / H - H / 4 * slope((q + new) / 2), residual)
        p, q = (new - q) / H + H / 2 * force((q + new) / 2), new
        assert largest_difference(joined(run)[0][k + 1], q) < 1e-12
        assert largest_difference(joined(run)[1][k + 1], p) < 1e-12


def test_one_explicit_micro_step_is_verlet(fpu):
    run = simulate(fpu.system, fully_explicit(1), fpu.state(), macro_dt=H, num_steps=STEPS)
    force, _ = force_of(fpu)
    q, p = start_of(fpu)
    for k in range(STEPS):
        p = p + H / 2 * force(q)
        q = q + H * p
        p = p + H / 2 * force(q)
        assert largest_difference(joined(run)[0][k + 1], q) < 1e-12
        assert largest_difference(joined(run)[1][k + 1], p) < 1e-12


def test_kicks_of_alpha_one_are_symplectic_euler(fpu):
    run = simulate(fpu.system, fully_explicit(1, 1.0), fpu.state(), macro_dt=H, num_steps=STEPS)
    force, _ = force_of(fpu)
    q, p = start_of(fpu)
    for k in range(STEPS):
        p = p + H * force(q)
        q = q + H * p
        assert largest_difference(joined(run)[0][k + 1], q) < 1e-12
        assert largest_difference(joined(run)[1][k + 1], p) < 1e-12


def test_many_explicit_micro_steps_are_the_impulse_method(fpu):
    """Kick by V, num_micro Verlet steps of W, kick by V (r-RESPA)."""
    n, omega = 4, 50.0
    run = simulate(fpu.system, fully_explicit(n), fpu.state(), macro_dt=H, num_steps=STEPS)
    gradient = jax.jit(jax.grad(lambda q: fpu.system.slow_potential(q[:3], q[3:], None)))
    q, p = start_of(fpu)
    stiff = np.repeat([0.0, omega**2], 3)
    for k in range(STEPS):
        p = p - H / 2 * np.asarray(gradient(q))
        for _ in range(n):
            p = p - H / n / 2 * stiff * q
            q = q + H / n * p
            p = p - H / n / 2 * stiff * q
        p = p - H / 2 * np.asarray(gradient(q))
        assert largest_difference(joined(run)[0][k + 1], q) < 1e-12
        assert largest_difference(joined(run)[1][k + 1], p) < 1e-12


@pytest.mark.parametrize(("springs", "num_micro"), [(3, 4), (200, 1), (200, 2), (200, 5), (200, 6)])
def test_implicit_micro_steps_of_linear_springs(springs, num_micro):
    """Kick by V, num_micro steps of the midpoint rule for W, kick by V: also where the chain is long."""
    problem, omega = systems.fermi_pasta_ulam(springs), 50.0
    run = simulate(problem.system, explicit_slow(num_micro), problem.state(), macro_dt=H, num_steps=5, save_micro=True)
    gradient = jax.jit(jax.grad(lambda q: problem.system.slow_potential(q[:springs], q[springs:], None)))
    q, p = start_of(problem)
    h, stiff = H / num_micro, np.repeat([0.0, omega**2], springs)
    for k in range(5):
        p = p - H / 2 * np.asarray(gradient(q))
        for m in range(num_micro):
            middle = (q + h / 2 * p) / (1 + h**2 / 4 * stiff)
            q, p = 2 * middle - q, p - h * stiff * middle
            assert largest_difference(run.q_f_micro[k, m], q[springs:]) < 1e-12
        p = p - H / 2 * np.asarray(gradient(q))
        assert largest_difference(joined(run)[0][k + 1], q) < 1e-12
        assert largest_difference(joined(run)[1][k + 1], p) < 1e-11


def test_derivative_of_linear_micro_steps_of_a_long_chain():
    problem = systems.fermi_pasta_ulam(200)

    def end(macro_dt):
        run = simulate(problem.system, explicit_slow(6), problem.state(), macro_dt=macro_dt, num_steps=2)
        return jnp.sum(run.p_f[-1][:3])

    slope = float(jax.jit(jax.grad(end))(H))
    assert slope == pytest.approx(float(end(H + 1e-6) - end(H - 1e-6)) / 2e-6, rel=1e-7)


def test_one_explicit_micro_step_with_constraints_is_rattle(tsp):
    macro_dt = 0.005
    run = simulate(tsp.system, fully_explicit(1), tsp.state(), macro_dt=macro_dt, num_steps=STEPS)
    force, _ = force_of(tsp)
    constraints = jax.jit(lambda q: tsp.system.constraints(0.0, q[:3], q[3:]))
    jacobian = jax.jit(jax.jacrev(constraints))
    mass = np.concatenate([tsp.system.kinetic.slow, tsp.system.kinetic.fast])
    q, p = start_of(tsp)
    for k in range(STEPS):
        G, free, multiplier = np.asarray(jacobian(q)), p + macro_dt / 2 * force(q), np.zeros(2)
        for _ in range(12):  # g(q + H M^-1 (free - H/2 G^T lambda)) = 0
            new = q + macro_dt / mass * (free - macro_dt / 2 * G.T @ multiplier)
            slope = -(macro_dt**2) / 2 * np.asarray(jacobian(new)) / mass @ G.T
            multiplier = multiplier - np.linalg.solve(slope, np.asarray(constraints(new)))
        q, p = new, free - macro_dt / 2 * G.T @ multiplier + macro_dt / 2 * force(new)
        G = np.asarray(jacobian(q))
        p = p - G.T @ np.linalg.solve(G / mass @ G.T, G @ (p / mass))
        assert largest_difference(joined(run)[0][k + 1], q) < 1e-12
        assert largest_difference(joined(run)[1][k + 1], p) < 1e-11  # slow momenta of size 100


def slow_well(q_s, q_f, params):
    return jnp.sum(q_s**4) / 4 + jnp.sum(jnp.cos(q_s))


@pytest.mark.parametrize("make", [explicit_slow, fully_explicit])
def test_without_coupling_the_slow_motion_does_not_depend_on_num_micro(make):
    problem = two_oscillators()
    system = problem.system.replace(slow_potential=slow_well)
    runs = [simulate(system, make(n), problem.state(), macro_dt=0.03, num_steps=100, save_every=10) for n in (1, 3, 8)]
    for run in runs[1:]:
        assert largest_difference(run.q_s, runs[0].q_s) < 1e-13
        assert largest_difference(run.p_s, runs[0].p_s) < 1e-13
        assert largest_difference(run.q_f, runs[0].q_f) > 1e-3


def test_without_coupling_the_fast_motion_does_not_depend_on_the_macro_step():
    """Ten macro steps of one micro step are one macro step of ten."""
    problem = two_oscillators()
    system = problem.system.replace(slow_potential=None)
    coarse = simulate(system, fully_implicit(10), problem.state(), macro_dt=0.1, num_steps=5)
    fine = simulate(system, fully_implicit(1), problem.state(), macro_dt=0.01, num_steps=50, save_every=10)
    assert largest_difference(coarse.q_f, fine.q_f) < 1e-13
    assert largest_difference(coarse.p_f, fine.p_f) < 1e-12


def test_one_system_under_two_names_of_one_scheme():
    """Rules that agree as sums give the same steps: lobatto(2) is trapezoidal, gauss(1) is midpoint."""
    problem = two_oscillators()
    kicks = [micro(quadrature.lobatto(2)), micro((quadrature.left + quadrature.right) / 2)]
    runs = [
        simulate(
            problem.system,
            Scheme(3, kinetic=micro(quadrature.gauss(1)), slow=macro(rule.rule), fast=rule),
            problem.state(),
            macro_dt=0.05,
            num_steps=10,
        )
        for rule in kicks
    ]
    expected = simulate(problem.system, fully_explicit(3), problem.state(), macro_dt=0.05, num_steps=10)
    assert all(largest_difference(run.q_f, expected.q_f) < 1e-14 for run in runs)
    assert problem.system.fast_potential is stiff_spring

"""Known methods as special cases, each written out in numpy: midpoint variational integrator, Verlet, impulses,
RATTLE."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.support import largest_difference, masses
from tests.user_systems import two_oscillators
from vmri_jax import Scheme, explicit_slow, fully_explicit, fully_implicit, macro, micro, quadrature, simulate, systems
from vmri_jax.mechanics.surroundings import name_of

H, STEPS, OMEGA = 0.02, 25, 50.0


def minus_slow(q, system):
    return -system.slow_potential(*jnp.split(q, [system.kinetic.slow.size]), system.params)


def minus_fast(q, system):
    return -system.fast_potential(q[system.kinetic.slow.size :], system.params)


DERIVATIVES = [
    jax.jit(derivative)
    for derivative in (
        jax.grad(minus_slow),
        jax.grad(minus_fast),
        jax.hessian(lambda q, system: minus_slow(q, system) + minus_fast(q, system)),
    )
]


def forces(problem):
    """``-dV/dq``, ``-dW/dq`` and the derivative of their sum, of all variables together."""
    return [lambda q, f=f: np.asarray(f(q, problem.system)) for f in DERIVATIVES]


def check(problem, scheme, step, macro_dt=H, num_steps=STEPS, p_bound=1e-12):
    """A run of the scheme goes where ``q, p = step(q, p)`` goes."""
    run = simulate(problem.system, scheme, problem.state(), macro_dt=macro_dt, num_steps=num_steps)
    nodes_q, nodes_p = np.concatenate([run.q_s, run.q_f], axis=1), np.concatenate([run.p_s, run.p_f], axis=1)
    q, p = nodes_q[0], nodes_p[0]
    for k in range(num_steps):
        q, p = step(q, p)
        assert largest_difference(nodes_q[k + 1], q) < 1e-12
        assert largest_difference(nodes_p[k + 1], p) < p_bound


def test_one_implicit_micro_step_is_the_midpoint_variational_integrator(fpu):
    slow, fast, slope = forces(fpu)

    def step(q, p):
        new = q + H * p
        for _ in range(8):  # p = (q+ - q) / H - H/2 F((q + q+) / 2), unit masses
            middle = (q + new) / 2
            residual = (new - q) / H - H / 2 * (slow(middle) + fast(middle)) - p
            new = new - np.linalg.solve(np.eye(6) / H - H / 4 * slope(middle), residual)
        middle = (q + new) / 2
        return new, (new - q) / H + H / 2 * (slow(middle) + fast(middle))

    check(fpu, fully_implicit(1), step)


@pytest.mark.parametrize(("num_micro", "alpha"), [(1, 0.5), (1, 1.0), (4, 0.5)], ids=["verlet", "euler", "r-RESPA"])
def test_explicit_micro_steps_are_the_impulse_method(fpu, num_micro, alpha):
    """Kick by V, num_micro steps of W by kicks and drifts, kick by V; a single one is Verlet's step, or symplectic
    Euler's."""
    slow, fast, _ = forces(fpu)
    h = H / num_micro

    def step(q, p):
        p = p + alpha * H * slow(q)
        for _ in range(num_micro):
            p = p + alpha * h * fast(q)
            q = q + h * p
            p = p + (1 - alpha) * h * fast(q)
        return q, p + (1 - alpha) * H * slow(q)

    check(fpu, fully_explicit(num_micro, alpha), step)


@pytest.mark.parametrize(("springs", "num_micro"), [(3, 4), (200, 1), (200, 5), (200, 6)])
def test_implicit_micro_steps_of_linear_springs(springs, num_micro):
    """Kick by V, num_micro steps of the midpoint rule for W, kick by V: also where the chain is long."""
    problem = systems.fermi_pasta_ulam(springs)
    slow, _, _ = forces(problem)
    h, stiff = H / num_micro, np.repeat([0.0, OMEGA**2], springs)

    def step(q, p):
        p = p + H / 2 * slow(q)
        for _ in range(num_micro):
            middle = (q + h / 2 * p) / (1 + h**2 / 4 * stiff)
            q, p = 2 * middle - q, p - h * stiff * middle
        return q, p + H / 2 * slow(q)

    check(problem, explicit_slow(num_micro), step, num_steps=5, p_bound=1e-11)


def test_derivative_of_linear_micro_steps_of_a_long_chain():
    problem = systems.fermi_pasta_ulam(200)

    def end(macro_dt):
        run = simulate(problem.system, explicit_slow(6), problem.state(), macro_dt=macro_dt, num_steps=5)
        return jnp.sum(run.p_f[-1][:3])

    program = jax.jit(jax.value_and_grad(end))
    difference = float(program(H + 1e-6)[0] - program(H - 1e-6)[0]) / 2e-6
    assert float(program(H)[1]) == pytest.approx(difference, rel=1e-7)


def test_one_explicit_micro_step_with_constraints_is_rattle(tsp):
    macro_dt = 0.005
    slow, fast, _ = forces(tsp)
    constraints = jax.jit(lambda q: tsp.system.constraints(0.0, q[:3], q[3:]))
    jacobian = jax.jit(jax.jacrev(constraints))
    mass = masses(tsp)

    def step(q, p):
        G, free = np.asarray(jacobian(q)), p + macro_dt / 2 * (slow(q) + fast(q))
        new, multiplier = q, np.zeros(2)
        for _ in range(12):  # g(q + H M^-1 (free - H/2 G^T lambda)) = 0
            new = q + macro_dt / mass * (free - macro_dt / 2 * G.T @ multiplier)
            slope = -(macro_dt**2) / 2 * np.asarray(jacobian(new)) / mass @ G.T
            multiplier = multiplier - np.linalg.solve(slope, np.asarray(constraints(new)))
        p = free - macro_dt / 2 * G.T @ multiplier + macro_dt / 2 * (slow(new) + fast(new))
        G = np.asarray(jacobian(new))
        return new, p - G.T @ np.linalg.solve(G / mass @ G.T, G @ (p / mass))

    check(tsp, fully_explicit(1), step, macro_dt, p_bound=1e-11)  # slow momenta of size 100


@pytest.mark.parametrize("make", [explicit_slow, fully_explicit])
def test_without_coupling_the_slow_motion_does_not_depend_on_num_micro(make):
    problem = two_oscillators()
    system = problem.system.replace(slow_potential=lambda q_s, q_f, params: jnp.sum(q_s**4) / 4 + jnp.sum(jnp.cos(q_s)))
    runs = [simulate(system, make(n), problem.state(), macro_dt=0.03, num_steps=100, save=10) for n in (1, 3)]
    assert largest_difference(runs[1].q_s, runs[0].q_s) < 1e-13
    assert largest_difference(runs[1].p_s, runs[0].p_s) < 1e-13
    assert largest_difference(runs[1].q_f, runs[0].q_f) > 1e-3


def test_without_coupling_the_fast_motion_does_not_depend_on_the_macro_step():
    """Ten macro steps of one micro step are one macro step of ten."""
    problem = two_oscillators()
    system = problem.system.replace(slow_potential=None)
    coarse = simulate(system, fully_implicit(10), problem.state(), macro_dt=0.1, num_steps=5)
    fine = simulate(system, fully_implicit(1), problem.state(), macro_dt=0.01, num_steps=50, save=10)
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
    assert name_of(problem.system.fast_potential) == "stiff_spring"

"""One macro step: the route chosen from rules and system, its end, its multipliers."""

import jax
import jax.numpy as jnp
import numpy as np

import vmri_jax as vm
from tests.stability.systems import swinging
from tests.support import compiled_step, largest_difference, without_fallback
from tests.user_systems import two_oscillators


def step(problem, scheme, macro_dt):
    return compiled_step(problem.system, scheme, problem.state(), macro_dt, without_fallback(problem, scheme))


def only_slow(q_s, q_f, params):
    return jnp.sum(q_s**4)


def test_split_and_coupled_routes_agree():
    """An implicit V of q_s alone is split off; made to look coupled, the same step is solved at once."""
    problem = two_oscillators()
    scheme = vm.Scheme(
        4,
        kinetic=vm.micro(vm.quadrature.midpoint),
        slow=vm.macro(vm.quadrature.midpoint),
        fast=vm.micro(vm.quadrature.midpoint),
    )
    separate = problem.system.replace(slow_potential=only_slow)
    together = problem.system.replace(slow_potential=lambda q_s, q_f, params: only_slow(q_s, q_f, params) + 0 * q_f[0])
    state = problem.state()
    a, b = (compiled_step(s, scheme, state, 0.1, without_fallback(s, scheme, state)) for s in (separate, together))
    assert largest_difference(a[1].q_f_micro, b[1].q_f_micro) < 1e-14
    for name in ("q_s", "q_f", "p_s", "p_f"):
        assert largest_difference(getattr(a[0], name), getattr(b[0], name)) < 1e-13


def test_the_step_is_the_discrete_legendre_transform(fpu):
    """The control points of the step have the start's momenta at one end and the new ones at the other;
    `tests/textbook` has other schemes."""
    start, scheme = fpu.state(), vm.explicit_slow(3, 0.2)
    end, info = step(fpu, scheme, 0.05)
    slow = np.stack([start.q_s, end.q_s])
    fast = np.concatenate([np.asarray(start.q_f)[None], info.q_f_micro])
    (p_s, p_f), (p_s_end, p_f_end) = jax.jit(vm.discrete_legendre(fpu.system, scheme))(slow, fast, 0.05)
    for a, b in ((p_s, start.p_s), (p_f, start.p_f), (p_s_end, end.p_s), (p_f_end, end.p_f)):
        assert largest_difference(a, b) < 1e-12  # measured 1e-14
    assert np.array_equal(info.q_f_micro[-1], end.q_f)
    assert float(end.t) == 0.05


def test_constraints_and_their_rates_hold_at_the_end_of_a_step_of_degree_two():
    """Of a double pendulum whose first rod is slow."""
    problem = swinging()
    end, info = step(problem, vm.galerkin(3, 2), 0.03)

    @jax.jit
    def rows_and_rates(system, end):
        at = 0.0, end.q_s, end.q_f
        return system.constraints(*at), system.constraint_rates(*at, *system.kinetic.velocity(end.p_s, end.p_f))

    assert np.abs(rows_and_rates(problem.system, end)).max() < 1e-12
    assert info.multiplier.shape == (3, 2, 1)
    assert info.slow_multiplier.shape == (2, 1)


def test_small_steps_lose_no_digits(fpu):
    """Relative accuracy of the momenta does not suffer from a tiny step: velocities come from increments."""
    start = fpu.state()
    for macro_dt in (1e-6, 1e-9):
        end, _ = step(fpu, vm.fully_implicit(3), macro_dt)
        drift = macro_dt * 2500 / 50  # omega^2 f_1, the largest force
        assert 0.9 * drift < largest_difference(end.p_f, start.p_f) < 1.1 * drift
        explicit, _ = step(fpu, vm.fully_explicit(3), macro_dt)
        assert largest_difference(end.p_f, explicit.p_f) < 1e-13 + macro_dt**2 * 2500

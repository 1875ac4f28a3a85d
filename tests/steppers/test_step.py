"""One macro step: its end, its multipliers, its digits."""

import jax
import numpy as np

import vmri_jax as vm
from tests.stability.systems import swinging
from tests.support import compiled_step, largest_difference, without_fallback


def step(problem, scheme, macro_dt):
    return compiled_step(problem.system, scheme, problem.state(), macro_dt, without_fallback(problem, scheme))


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

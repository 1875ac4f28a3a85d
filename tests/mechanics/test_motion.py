"""Accelerations, multipliers and reaction forces of the continuous equations, against formulas and runs."""

import jax
import numpy as np
import pytest

from tests.user_systems import GRAVITY, LENGTH, MASS, double_pendulum, drag, hanging_weight, own_rod, swinging_rod
from vmri_jax import ConstantMass, Rheonomic, State, System, fully_implicit, galerkin, initial_state, simulate
from vmri_jax.mechanics.invariants import energy
from vmri_jax.mechanics.motion import motion, powers, reaction_forces


def test_a_pendulum_by_the_formula():
    system = System(ConstantMass(np.zeros(0), MASS * np.ones(2)), fast_potential=hanging_weight, constraint=own_rod)
    state = initial_state(system, [], LENGTH * np.array([0.6, -0.8]), [], np.array([0.8, 0.6]))
    found = jax.jit(motion)(system, state)
    tension = MASS * (1.0 + GRAVITY * 0.8 * LENGTH) / LENGTH**2  # m (v^2 - g y) / L^2
    assert float(found.multipliers[0]) == pytest.approx(tension, rel=1e-13)
    (pull,), touched = jax.jit(lambda state: reaction_forces(system, (state, np.ones((1, 1), bool))))(state)
    assert touched.all()
    assert np.allclose(pull, -tension * state.q_f, rtol=1e-13)
    assert np.allclose(found.a_f, pull / MASS - np.array([0.0, GRAVITY]), rtol=1e-13)


def test_multipliers_of_rods_that_do_not_couple_have_derivatives():
    """``lambda_i = -g y_i / |q_i|^2`` of two pendulums at rest; derivatives of `jnp.linalg.lstsq` are NaN, as their
    singular values are equal."""
    rods = jax.vmap(lambda q: own_rod([], q, None)[0])
    system = System(
        ConstantMass([], np.ones(4)),
        fast_potential=lambda q, _: GRAVITY * (q[1] + q[3]),
        constraint=lambda q_s, q_f, params: rods(q_f.reshape(2, 2)),
    )
    q = np.array([0.6, -0.8, 0.8, -0.6])
    zero = np.zeros(4)
    slope = jax.grad(lambda q: motion(system, State(0.0, zero[:0], q, zero[:0], zero)).multipliers.sum())(q)
    y, squared = q[1::2], (q.reshape(2, 2) ** 2).sum(axis=1)
    expected = 2 * GRAVITY * (y / squared**2)[:, None] * q.reshape(2, 2) - GRAVITY / squared[:, None] * np.array([0, 1])
    assert np.allclose(slope, expected.ravel(), rtol=1e-12)


def test_accelerations_are_those_of_runs():
    """Of a mass that depends on the positions."""
    problem = double_pendulum()
    system, state = problem.system, problem.state()
    h = 1e-3
    run = simulate(system, galerkin(1, 2), state, macro_dt=h, num_steps=2)
    middle = State(*(a[1] for a in (run.t, run.q_s, run.q_f, run.p_s, run.p_f)))
    found = jax.jit(motion)(system, middle)
    for q, a in ((run.q_s, found.a_s), (run.q_f, found.a_f)):
        assert np.allclose(
            (q[2] - 2 * q[1] + q[0]) / h**2, a, rtol=1e-4, atol=1e-4
        )  # measured 2e-5, of the difference itself


def test_powers_are_the_rate_of_energy():
    system = System(
        ConstantMass(np.zeros(0), MASS * np.ones(2)), None, hanging_weight, Rheonomic(swinging_rod), force=drag
    )
    state = initial_state(system, [], [LENGTH, 0.0], [], [0.0, 1.0], project=True)
    run = simulate(system, fully_implicit(1), state, macro_dt=1e-3, num_steps=1000)
    states = State(run.t, run.q_s, run.q_f, run.p_s, run.p_f)
    rates = np.asarray(jax.jit(jax.vmap(powers, (None, 0)))(system, states))
    work = 1e-3 * (np.cumsum(rates, axis=0) - (rates + rates[0]) / 2)
    change = run.energy - run.energy[0]
    assert np.abs(change).max() > 1.0
    assert np.abs(work).max(axis=0).min() > 0.1  # forces and constraints both take part
    assert np.allclose(change, work.sum(axis=1), atol=2e-5 * np.abs(change).max())
    assert float(energy(system, *(a[-1] for a in (run.q_s, run.q_f, run.p_s, run.p_f)))) == pytest.approx(
        float(run.energy[-1])
    )

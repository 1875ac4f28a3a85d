"""The hard cases of a system that is not ours."""

import jax.numpy as jnp
import pytest
from vmri_jax.hard.own_system import own_system

from tests.user_systems import two_oscillators
from vmri_jax import ConstantMass, Problem, System
from vmri_jax.hard import cases_for, run_cases


def weight(q_s, q_f, params):
    return 9.81 * q_f[1]


def rope(q_s, q_f, params):
    return jnp.array([((q_f[0] - q_s[0]) ** 2 + q_f[1] ** 2 - 1.0) / 2])


def crane() -> Problem:
    system = System(ConstantMass([5.0], [1.0, 1.0]), weight, constraint=rope)
    return Problem(system, jnp.zeros(1), jnp.array([0.6, -0.8]), jnp.zeros(1), jnp.zeros(2))


def leaning(q_s, q_f, params):
    """Pushes the slow variable over: no equilibrium, energy without a floor."""
    return -5e3 * jnp.sum(q_s**2) + jnp.sum((q_s - q_f) ** 2)


def spring(q_f, params):
    return 50 * jnp.sum(q_f**2)


def titles(problem):
    return [case.title for case in cases_for(problem)]


def test_cases_without_sense_are_left_out():
    free, constrained = titles(two_oscillators()), titles(crane())
    assert {"explicit limit", "reductions", "energy for long", "advice"} <= set(free)
    assert "constraints for long" not in free
    assert "rank of the constraints" not in free
    assert {"constraints for long", "rank of the constraints", "reductions"} <= set(constrained)
    assert "explicit limit" not in constrained


def test_steps_come_from_the_frequencies():
    own = own_system(two_oscillators(omega=50.0))
    assert own.omega == pytest.approx(50.0, rel=0.01)
    assert own.macro_dt == pytest.approx(1 / 50.0, rel=0.01)
    assert 0.5 < own_system(crane()).omega < 30  # nothing vibrates without the force of the rope


@pytest.mark.full
def test_two_oscillators_meet_every_criterion():
    report = run_cases(cases=cases_for(two_oscillators()))
    assert report.passed, report.markdown()


def test_a_crane_keeps_its_rope():
    report = run_cases([2, 3, 5], cases=cases_for(crane()))
    assert report.passed, report.markdown()
    assert report.rows[1].outcome.values["constraint"] < 3e-12  # measured 8e-13 at H = 0.43


def test_a_run_that_blows_up_is_missed_not_raised():
    one = jnp.ones(1)
    problem = Problem(System(ConstantMass([1.0], [1.0]), leaning, spring), one, one, 0 * one, 0 * one)
    [energy] = [case for case in cases_for(problem) if case.title == "energy for long"]
    outcome = energy.run(False)
    assert not outcome.passed
    assert "NON_FINITE" in outcome.measured

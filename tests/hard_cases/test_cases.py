"""The hard cases of a system that is not ours."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.hard_cases.broken_systems import no_potential, swapped_labels, wrong_gradient
from tests.scene.gallery_scenes import SCENES, gallery_scene
from tests.support import set_up
from tests.user_systems import two_oscillators
from vmri_jax import ConstantMass, Problem, Rheonomic, System
from vmri_jax.accuracy.companions import resting
from vmri_jax.hard_cases import cases, cases_for, run_cases
from vmri_jax.hard_cases.cases import resolved


def rope(q_s, q_f, params):
    return jnp.array([((q_f[0] - q_s[0]) ** 2 + q_f[1] ** 2 - 1.0) / 2])


def crane() -> Problem:
    system = System(ConstantMass([5.0], [1.0, 1.0]), lambda q_s, q_f, params: 9.81 * q_f[1], constraint=rope)
    return Problem(system, jnp.zeros(1), jnp.array([0.6, -0.8]), jnp.zeros(1), jnp.zeros(2))


def leaning(q_s, q_f, params):
    """Pushes the slow variable over: no equilibrium, energy without a floor."""
    return -5e3 * jnp.sum(q_s**2) + jnp.sum((q_s - q_f) ** 2)


def spring(q_f, params):
    return 50 * jnp.sum(q_f**2)


def lifted_rope(t, q_s, q_f, params):
    return jnp.array([((q_f[0] - q_s[0]) ** 2 + q_f[1] ** 2 - (1.0 + 0.01 * jnp.sin(t)) ** 2) / 2])


def hoist() -> Problem:
    """The crane with a rope that is wound up and down."""
    system = crane().system.replace(constraint=Rheonomic(lifted_rope))
    return Problem(system, jnp.zeros(1), jnp.array([0.6, -0.8]), jnp.zeros(1), jnp.array([0.008, 0.006]), project=True)


def damped() -> Problem:
    problem = two_oscillators()
    system = problem.system.replace(force=lambda t, q_s, q_f, v_s, v_f, params: (-0.1 * v_s, -0.1 * v_f))
    return Problem(system, problem.q_s, problem.q_f, problem.v_s, problem.v_f)


def field(q_s, q_f, v_s, v_f, params):
    """A charge in a magnetic field."""
    return (v_s @ v_s + v_f @ v_f) / 2 + 40.0 * (q_f[0] * v_f[1] - q_f[1] * v_f[0]) / 2


def magnetic() -> Problem:
    system = System(field, fast_potential=spring)
    return Problem(system, jnp.ones(1), jnp.array([1.0, 0.0]), jnp.ones(1), jnp.array([0.0, 1.0]))


def reasons(problem):
    """Why cases do not apply, by title."""
    return {case.title: case.does_not_apply for case in cases_for(problem) if case.does_not_apply}


def test_cases_without_sense_say_why():
    assert reasons(two_oscillators()) == {
        "rank of the constraints": "the system has no constraints",
        "constraints for long": "the system has no constraints",
    }
    assert list(reasons(crane())) == ["explicit limit"]


REASONS = {
    "rank of the constraints": "has no constraints",
    "constraints for long": "has no constraints",
    "energy for long": "no energy is kept",
    "reversibility": "the way back is another motion",
    "explicit limit": "every step solves",
}
"""Words that only the reason of this row has."""


@pytest.mark.parametrize("make", [crane, hoist, damped, magnetic], ids=lambda make: make.__name__)
def test_reasons_are_about_their_own_row(make):
    reason = reasons(make())
    for title, why in reason.items():
        assert {words for words in REASONS.values() if words in why} == {REASONS[title]}
    assert (make is crane) or {"reversibility", "explicit limit"} <= set(reason)
    assert ("energy for long" in reason) == (make in (hoist, damped))


def test_steps_are_those_of_the_textbook():
    """With a force; `tests/textbook` has all other terms."""
    (case,) = [case for case in cases_for(damped()) if case.title == "textbook"]
    outcome = case.run(False)
    assert outcome.passed, outcome.measured


@pytest.mark.full
@pytest.mark.parametrize("make", [crane, hoist, damped, two_oscillators])
def test_every_criterion_that_applies_is_met(make):
    """At rest, driven or damped; a crane keeps its rope.

    The tests of pages run `vmri check` on the crane of the nutshell.
    """
    report = run_cases(cases_for(make()))
    assert report.passed, str(report)
    if make is crane:
        [third] = [row for row in report.rows if row.case.number == 3]
        assert third.values["constraint"] < 3e-12  # measured 8e-13 at H = 0.43


@pytest.mark.full
@pytest.mark.parametrize("name", SCENES)
def test_every_scene_of_the_gallery_is_healthy(name):
    report = run_cases(cases_for(gallery_scene(name)))
    assert report.passed, str(report)


def test_steps_come_from_the_frequencies():
    own = resolved(two_oscillators(omega=50.0))
    assert own.omega == pytest.approx(50.0, rel=0.01)
    assert own.macro_dt == pytest.approx(1 / 50.0, rel=0.01)
    assert 0.5 < resolved(crane()).omega < 30  # nothing vibrates without the force of the rope


@pytest.mark.parametrize(
    ("make", "title", "words"),
    [
        (wrong_gradient, "derivatives", "the gradient of fast_potential from differences of its values differs by 0.3"),
        (no_potential, "derivatives", "Forces without a potential belong into force"),
        (swapped_labels, "advice", "is one of the slow variables q_s[0]"),
    ],
)
def test_what_is_broken_is_found(make, title, words):
    [case] = [case for case in cases_for(make()) if case.title == title]
    report = run_cases([case])
    assert not report.passed
    assert words in report.rows[0].measured


def test_right_derivatives_are_right():
    [case] = [case for case in cases_for(two_oscillators()) if case.title == "derivatives"]
    outcome = case.run(False)
    assert outcome.passed, outcome.measured
    assert outcome.values["apart"] < 1e-10  # measured 1e-16, of the crane 1e-11


def test_a_magnetic_field_sets_the_step_and_has_no_way_back():
    problem = magnetic()
    assert "sign of velocities" in reasons(problem)["reversibility"]
    assert resolved(problem).omega == pytest.approx(20 + 500**0.5, rel=1e-6)  # of the spring alone 10


def test_a_run_that_blows_up_is_missed_not_raised():
    one = jnp.ones(1)
    problem = Problem(System(ConstantMass([1.0], [1.0]), leaning, spring), one, one, 0 * one, 0 * one)
    [energy] = [case for case in cases_for(problem) if case.title == "energy for long"]
    outcome = energy.run(False)
    assert not outcome.passed
    assert "NON_FINITE" in outcome.measured


@pytest.mark.parametrize(
    ("energy_at", "passes"),
    [
        (lambda steps: 1e-8 * steps, False),  # goes on
        (lambda steps: 1e-4 * np.sin(steps / 3e4), True),  # turns back in a longer run
        (lambda steps: 1e-4 * np.tanh(steps / 1.5e4), True),  # settles
    ],
)
def test_a_drift_goes_on_and_what_is_slow_does_not(monkeypatch, energy_at, passes):
    problem = two_oscillators()
    start = resting(set_up(problem, vm.fully_implicit(1), 0.01, 100))

    def long_run(problem, scheme, macro_dt, num_steps):
        return dataclasses.replace(start, energy=1.0 + energy_at(np.linspace(0.0, num_steps, len(start))))

    monkeypatch.setattr(cases, "long_run", long_run)
    [case] = [case for case in cases_for(problem) if case.title == "energy for long"]
    assert run_cases([case]).passed == passes

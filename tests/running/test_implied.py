"""Rows that are left out since the constraints imply them: not solved for, but watched."""

import jax
import numpy as np
import pytest

import vmri_jax as vm
from vmri_jax import ConstantMass, Problem, Result, Rheonomic, System

STEPS = {"macro_dt": 0.01, "num_steps": 40}
SCHEME = vm.fully_explicit(2)


def on_a_line(q_s, q_f, params):
    """A point that keeps to the line x = 0."""
    return q_f[:1]


def on_a_tilted_line(q_s, q_f, params):
    """It follows from x = 0 only without a tilt; at the start, y = 0, in any case."""
    return q_f[:1] + params["tilt"] * q_f[1:2]


def at_times(t, q_s, q_f, params):
    return on_a_tilted_line(q_s, q_f, params) + 0.0 * t


def across_the_plane(q_s, q_f, params):
    """Round-off alone, as the row across the plane of a linkage."""
    return 6e-17 * jax.numpy.cos(q_f[1:2])


def falling(tilt, implied=on_a_tilted_line) -> Problem:
    mass = ConstantMass(np.zeros(0), [1.0, 1.0])
    system = System(mass, constraint=on_a_line, implied=implied, params={"tilt": np.array(tilt)})
    return Problem(system, [], [0.0, 0.0], [], [0.0, 1.0])


def test_rows_that_follow_cost_no_multiplier_and_count_in_the_residual():
    problem = falling(0.0)
    run = vm.simulate(problem, SCHEME, **STEPS)
    assert run.success
    assert problem.system.num_constraints(problem.q_s, problem.q_f) == (1, 0)
    assert list(run.multipliers()) == ["constraint"]
    assert run.constraint_residual.max() < 1e-15  # measured 0
    assert vm.simulate(falling(0.0, across_the_plane), SCHEME, **STEPS).success
    tilted = vm.simulate(falling(1e-14), SCHEME, **STEPS)  # below the round-off of positions, and seen
    np.testing.assert_allclose(tilted.constraint_residual[:, 0], 1e-14 * tilted.q_f[:, 1], atol=1e-27)
    np.testing.assert_allclose(tilted.constraint_residual[:, 1], 1e-14, rtol=1e-12)


@pytest.mark.parametrize("implied", [on_a_tilted_line, Rheonomic(at_times)])
def test_a_run_whose_implied_rows_leave_zero_stops(implied):
    """The row is not zero after the first step: x = 0 and y = t leave it tilt t, far above the round-off of y."""
    with pytest.raises(vm.SimulationError, match=r"NOT_IMPLIED.*rows that were left out.*Start elsewhere") as failed:
        vm.simulate(falling(1e-9, implied), SCHEME, **STEPS)
    run = failed.value.trajectory
    assert (run.result, failed.value.step) == (Result.NOT_IMPLIED, 0)
    assert np.isfinite(run.q_f[:1]).all()
    assert np.isnan(run.q_f[1:]).all()


def test_lanes_fail_alone():
    problem, tilts = falling(0.0), np.array([0.0, 1e-3, 1e-9])
    states = jax.tree.map(lambda a: np.stack([a] * 3), problem.state())
    with pytest.warns(vm.FailedLanesWarning, match=r"2 of 3 lanes failed.*lane 1, at macro step 0 \(NOT_IMPLIED\)"):
        run = vm.simulate_batch(
            problem.system, SCHEME, states, params={"tilt": tilts}, solver=vm.Solver("masses"), **STEPS
        )
    assert run.result.tolist() == [Result.CONVERGED, Result.NOT_IMPLIED, Result.NOT_IMPLIED]
    assert run.failed_at.tolist() == [-1, 0, 0]


def test_what_cannot_be_implied_is_refused():
    mass = ConstantMass(np.zeros(0), [1.0, 1.0])
    alone = System(mass, implied=on_a_line)
    with pytest.raises(ValueError, match="implied is given, but neither constraint nor slow_constraint"):
        vm.initial_state(alone, [], [0.0, 0.0], [], [0.0, 1.0])
    with pytest.raises(ValueError, match=r"implied does not follow from the constraints: .* row\(s\) \[0\] .* are"):
        Problem(falling(0.5).system, [], [0.0, 1.0]).state()
    scalar = System(mass, constraint=on_a_line, implied=lambda q_s, q_f, params: q_f[0])
    with pytest.raises(ValueError, match=r"System: implied returns shape \(\); it must return a vector"):
        vm.initial_state(scalar, [], [0.0, 0.0], [], [0.0, 1.0])

"""Estimated errors of runs against references, their shares against the limits of each grid, and how they are
printed."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import vmri_jax as vm
from tests.small_systems import NONE, SYSTEMS, no_constraint
from tests.support import set_up
from vmri_jax.accuracy import search
from vmri_jax.accuracy.companions import UncertifiedWarning
from vmri_jax.study import reference_solution

LENGTH, NODES = 2.0, 10


def positions(run) -> np.ndarray:
    return np.concatenate([run.q_s, run.q_f], axis=1)


def largest_difference(a, b) -> float:
    return float(np.abs(positions(a) - positions(b)).max())


CASES = {
    "kicks": ("no_constraint", vm.fully_explicit(8), 20),
    "order 1": ("no_constraint", vm.fully_explicit(8, alpha=0.3), 400),
    "averaged kicks": ("no_constraint", vm.mollified_impulse(8), 40),
    "midpoint": ("no_constraint", vm.fully_implicit(5), 40),
    "composition": ("no_constraint", vm.compose(vm.fully_explicit(2), "suzuki4"), 20),
    "order 6": ("fast_alone", vm.compose(vm.fully_explicit(2), "kahan-li6"), 20),
    "slow alone": ("slow_alone", vm.fully_explicit(1), 20),
    "one coordinate": ("one_coordinate", vm.galerkin(1, 2), 10),
    "constraint": ("constraint", vm.fully_implicit(5), 40),
    "constraint, order 8": ("constraint", vm.galerkin(1, 4, "lobatto"), 10),
    "damped": ("damped", vm.explicit_slow(8), 20),
    "driven": ("driven", vm.fully_explicit(8), 20),
    "moving constraints": ("moving_constraints", vm.fully_implicit(5), 40),
    "own kinetic energy": ("kinetic_function", vm.fully_implicit(4), 40),
    "scene": ("scene_of_points", vm.fully_implicit(6), 40),
    "rigid bodies": ("scene_of_rigid_bodies", vm.fully_implicit(5), 40),
}


QUICK = ("order 1", "composition", "constraint, order 8")


@pytest.mark.parametrize(
    "case", [case if case in QUICK else pytest.param(case, marks=pytest.mark.full) for case in CASES]
)
def test_estimate_over_true_error(case):
    name, scheme, num_steps = CASES[case]
    steps = {"macro_dt": LENGTH / num_steps, "num_steps": num_steps, "save": num_steps // NODES}
    run = vm.simulate(SYSTEMS[name], scheme, **steps, error=True)
    true = reference_solution(SYSTEMS[name], LENGTH, num_saves=NODES).errors(run)[0]
    assert true > 1e-6  # an error of the scheme, not of the reference
    assert run.error.largest == pytest.approx(true, rel=0.1)  # 0.1 % to 7 % measured


def test_shares_are_the_limits_of_each_grid():
    """The fast share goes with many micro steps; with N single steps for each macro step, the slow share."""
    problem, num_micro, num_steps = SYSTEMS["no_constraint"], 8, 20

    def run(scheme, parts=1, **more):
        steps = {"macro_dt": 0.1 / parts, "num_steps": num_steps * parts, "save": 2 * parts}
        return vm.simulate(problem, scheme, **steps, **more)

    whole = run(vm.fully_explicit(num_micro), error="shares")
    without_fast, without_slow = run(vm.fully_explicit(16 * num_micro)), run(vm.fully_explicit(1), num_micro)
    assert whole.error.fast.max() == pytest.approx(largest_difference(whole, without_fast), rel=0.05)
    assert whole.error.slow.max() == pytest.approx(largest_difference(whole, without_slow), rel=0.05)


def test_error_of_a_function():
    problem = SYSTEMS["no_constraint"]
    steps = {"macro_dt": 0.05, "num_steps": 20}
    each = vm.simulate(problem, vm.fully_explicit(4), **steps, error=lambda run: run.q_f[:, 1])
    np.testing.assert_array_equal(each.error.of, each.error.q_f[:, 1])
    assert each[::5].error.of.shape == (5,)
    end = vm.simulate(problem, vm.fully_explicit(4), **steps, error=lambda run: jnp.sum(run.q_s[-1]))
    assert end.error.of == pytest.approx(end.error.q_s[-1].sum())
    assert end[::5].error.of == end.error.of


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (lambda run: "far", "returned 'far'"),
        (1e-3, "error is 0.001; it must be True or False, 'shares', or a function of a run"),
    ],
)
def test_refused(error, message):
    with pytest.raises(vm.Refused, match=message):
        vm.simulate(SYSTEMS["no_constraint"], vm.fully_explicit(4), macro_dt=0.05, num_steps=2, error=error)


def test_not_in_transformations():
    def end(macro_dt):
        return vm.simulate(SYSTEMS["slow_alone"], vm.fully_explicit(1), macro_dt=macro_dt, num_steps=2, error=True).q_s

    with pytest.raises(ValueError, match=r"outside of jax\.jit"):
        jax.jit(end)(0.1)


def test_parts_and_files(tmp_path):
    problem = SYSTEMS["no_constraint"]
    run = vm.simulate(problem, vm.fully_explicit(4), macro_dt=0.05, num_steps=20, error="shares")
    assert "slow share" in repr(run)
    part = run[4::4]
    np.testing.assert_array_equal(part.error.positions, run.error.positions[4::4])
    run.save(tmp_path / "run.npz")
    read = vm.Trajectory.load(tmp_path / "run.npz")
    for a, b in zip(read.error[:4], run.error[:4], strict=True):
        np.testing.assert_array_equal(a, b)
    columns = run.columns()
    np.testing.assert_array_equal(columns["error"], run.error.positions)
    assert {"error, slow share", "error, fast share"} <= set(columns)
    dataset = run.to_xarray()
    np.testing.assert_array_equal(dataset["error_q_f"], run.error.q_f)
    assert jax.tree.map(lambda a: a, run).error.is_certified
    assert "q_s" in repr(jax.eval_shape(lambda error: error, run.error))


def double_pendulum() -> vm.Problem:
    """Two rods of unit length and masses at their ends, in angles; released from above, the motion is chaotic."""

    def kinetic(q_s, q_f, v_s, v_f, params):
        (a, b), (u, w) = q_s, v_s
        return u**2 + w**2 / 2 + u * w * jnp.cos(a - b)

    def weight(q_s, q_f, params):
        return -9.81 * (2 * jnp.cos(q_s[0]) + jnp.cos(q_s[1]))

    return vm.Problem(vm.System(kinetic, weight), [2.5, 2.0], NONE, [0.0, 0.0], NONE)


def last(run):
    return run.q_s[-1, 0]


def test_chaotic_motion_is_not_certified():
    with pytest.warns(UncertifiedWarning, match=r"the motion is chaotic.*The energy has changed by at most"):
        run = vm.simulate(double_pendulum(), vm.galerkin(1, 3), macro_dt=0.05, t_end=30.0, error=last)
    until = float(run.error.certified_until)
    assert 2.0 < until < 30.0
    np.testing.assert_array_equal(np.isnan(run.error.positions), np.asarray(run.t) > until)
    assert run.error.largest == np.inf
    assert f"until t = {until:.4g}" in run.error.in_words()
    assert np.isnan(run.error.of)
    assert "no error is certified" in repr(run[-3:].error)


def test_chaotic_motion_misses_the_accuracy(monkeypatch):
    monkeypatch.setattr(search, "MOST_TRIAL_SECONDS", 0.0)
    monkeypatch.setattr(search, "FEWEST_STEPS", 1024)
    with pytest.warns(vm.AccuracyNotReached, match="no error is certified"), pytest.warns(match="chaotic"):
        run = vm.simulate(double_pendulum(), vm.galerkin(1, 3), accuracy=1e-3, t_end=40.0)
    assert run.error.largest == np.inf


def test_steps_that_do_not_see_the_motion_are_not_certified():
    with pytest.warns(UncertifiedWarning, match="Take smaller steps"):
        run = vm.simulate(SYSTEMS["slow_alone"], vm.fully_explicit(1), macro_dt=0.6, num_steps=40, error=True)
    assert not run.error.is_certified


def test_the_order_is_that_of_all_potentials():
    """A potential on every second micro node has the trapezoidal rule, whatever the order of the scheme."""
    problem = no_constraint()
    joined = replace(problem, system=problem.system.replace(potentials={2: lambda q_s, q_f, params: jnp.sum(q_f**2)}))
    for moving, order in ((problem, 6), (joined, 2)):
        assert set_up(moving, vm.galerkin(2, 3), 0.1, 1).order == order


def test_past_a_singular_configuration():
    """A parallelogram of bars turns through its flat poses, where the rows of its constraints depend on each other: it
    stays a parallelogram, and its error is that of the pendulum that it is."""
    start, speed = 0.3, -6.0

    def bars(q_s, q_f, params):
        a, b = q_f[:2], q_f[2:]
        crank, rocker, rod = a, b - jnp.array([2.0, 0.0]), b - a
        return jnp.array([crank @ crank - 1, rocker @ rocker - 1, rod @ rod - 4]) / 2

    def weight(q_s, q_f, params):
        return 9.81 * (q_f[1] + q_f[3])

    def turned(angle):
        crank = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
        return jnp.concatenate([crank, crank + jnp.array([2.0, 0.0])], axis=-1)

    system = vm.System(vm.ConstantMass([], np.ones(4)), weight, None, bars)
    velocity = speed * np.array([-np.sin(start), np.cos(start)] * 2)
    parallelogram = vm.Problem(system, [], turned(start), [], velocity)
    run = vm.simulate(parallelogram, vm.fully_implicit(1), macro_dt=0.01, num_steps=100, error=True)

    def rate(t, y):
        return [y[1], -9.81 * np.cos(y[0])]

    angle = solve_ivp(rate, (0, 1.0), [start, speed], "DOP853", np.asarray(run.t), rtol=1e-12, atol=1e-12).y[0]
    assert angle.min() < -np.pi < 0 < angle.max()  # past both flat poses
    true = float(np.abs(run.q_f - turned(angle)).max())
    assert run.error.is_certified
    assert run.error.largest == pytest.approx(true, rel=0.01)  # 3.274e-3 over 3.271e-3 measured

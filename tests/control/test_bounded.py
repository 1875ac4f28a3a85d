"""Bounds and limits against solutions that are known."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import vmri_jax as vm
from vmri_jax.control import bounded, minimize, riccati
from vmri_jax.scene import Body, Controlled, Scene

pytest.importorskip("piqp")
CART = Scene([Body("cart", 1.0, [0.0], pace="slow")], [Controlled("cart", "force")])


def effort(state, u):
    return u @ u / 2


def at_rest_at_one(state):
    return jnp.concatenate([state.q_s - 1.0, state.p_s])


def least(steps: int = 20, **asked):
    return minimize(
        CART, effort, goal=at_rest_at_one, scheme=vm.fully_explicit(1), macro_dt=1 / steps, num_steps=steps, **asked
    )


def cost_with_bounds(most: float) -> float:
    """The control is a straight line that is cut off: its slope from the distance."""
    t = np.linspace(0.0, 1.0, 100_001)
    h = t[1]

    def cut(slope):
        return np.clip(slope * (0.5 - t), -most, most)

    def way(slope):
        u = cut(slope)
        speed = np.cumsum((u[1:] + u[:-1]) / 2) * h
        return speed.sum() * h - 1

    return float(np.trapezoid(cut(brentq(way, 12.0, 1000.0)) ** 2, t) / 2)


def test_bounds_are_kept_at_the_least_cost():
    """Order 2."""
    exact = cost_with_bounds(4.5)
    found = [least(steps, bounds=(-4.5, 4.5)) for steps in (20, 40)]
    assert all(optimum.success for optimum in found)
    assert all(np.abs(optimum.controls).max() <= 4.5 + 1e-9 for optimum in found)
    errors = [optimum.cost - exact for optimum in found]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1)


def test_a_limit_of_speed():
    """Parabolas of speed up to the limit V and down: their time is 3/2 (1 - 1/V), the cost 4 V^2 / 3 over it."""
    limit = 1.2
    found = least(80, limits=lambda state, u: state.p_s - limit)
    assert found.success
    assert np.asarray(found.trajectory.p_s).max() == pytest.approx(limit, abs=1e-8)
    assert found.cost == pytest.approx(4 * limit**2 / (4.5 * (1 - 1 / limit)), rel=1e-3)


def test_wide_bounds_change_nothing():
    free, bound = least(), least(bounds=(None, 100.0))
    np.testing.assert_allclose(bound.controls, free.controls, atol=1e-7)
    np.testing.assert_allclose(bound.multipliers, free.multipliers, rtol=1e-6)


def test_a_goal_out_of_the_reach_of_bounds_is_said():
    """Full force one way, then the other, comes 3/4 of the way."""
    found = least(bounds=(-3.0, 3.0))
    assert not found.success
    assert found.miss == pytest.approx(0.25, abs=1e-6)
    assert "goal missed by 2.5e-01" in str(found)


def test_another_optimum_to_start_from():
    cold = least(40, bounds=(-4.5, 4.5))
    fine = least(40, bounds=(-4.5, 4.5), start=least(bounds=(-4.5, 4.5)))
    assert fine.history[0]["update"] < cold.history[0]["update"]
    assert fine.cost == pytest.approx(cold.cost, rel=1e-9)


def test_the_problem_driven_by_what_was_found():
    """Simulated, it moves as was found."""
    found = least()
    run = vm.simulate(found.problem, vm.fully_explicit(1), macro_dt=0.05, num_steps=20)
    np.testing.assert_allclose(run.q_s, found.trajectory.q_s, atol=1e-13)
    np.testing.assert_allclose(run.p_s[-1], found.trajectory.p_s[-1], atol=1e-13)


def test_against_the_sweep():
    """On a random linear-quadratic problem, with limits that do not hold."""
    random = np.random.default_rng(3)
    count, n, m, e = 5, 4, 2, 2
    roots = random.normal(size=(count, n + m, n + m))
    stages = riccati.Stages(
        roots @ roots.transpose(0, 2, 1),
        random.normal(size=(count, n + m)),
        random.normal(size=(count, n, n)),
        random.normal(size=(count, n, m)),
        random.normal(size=(count, n)),
    )
    final = riccati.Final(np.eye(n), random.normal(size=n), random.normal(size=(e, n)), random.normal(size=e))
    far = np.full((count, m), 1e4)
    limits = bounded.Limits(
        random.normal(size=(count, 1, n)), random.normal(size=(count, 1, m)), np.full((count, 1), -1e5), -far, far
    )
    found, _ = bounded.solve(stages, final, limits)
    expected = riccati.solve(stages, final)
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    ("message", "options"),
    [
        ("bounds is 3.0; give", {"bounds": 3.0}),
        ("must be below the largest", {"bounds": (1.0, -1.0)}),
        ("bounds have shapes", {"bounds": ([1.0, 2.0], 3.0)}),
        (r"limits has shape \(\); it must be a vector", {"limits": lambda state, u: state.q_s[0]}),
        ("actuate is given, and the scene", {"actuate": lambda q_s, q_f, u, params: (u, q_f), "num_controls": 1}),
        ("num_controls is 2; the scene has 1", {"num_controls": 2}),
        ("derivatives of limits are not finite", {"limits": lambda state, u: jnp.log(state.q_s - 2.0)}),
    ],
)
def test_bad_input(message, options):
    with pytest.raises((ValueError, RuntimeError), match=message):
        least(**options)


def test_a_start_of_another_duration():
    with pytest.raises(ValueError, match="start is an Optimum of duration 1; num_steps macro steps last 2"):
        minimize(CART, effort, scheme=vm.fully_explicit(1), macro_dt=0.1, num_steps=20, start=least())


def test_a_scene_without_controls():
    with pytest.raises(ValueError, match="nothing is controlled; give a scene with Controlled effects"):
        minimize(Scene([Body("cart", 1.0, [0.0])]), effort, scheme=vm.fully_explicit(1), macro_dt=0.1, num_steps=5)

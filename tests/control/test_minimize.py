"""Optimal control against solutions that are known, under constraints, bounds and limits."""

from dataclasses import replace
from functools import cache
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.linalg import expm
from scipy.optimize import brentq

import vmri_jax as vm
from tests.user_systems import cart
from vmri_jax.control import minimize
from vmri_jax.control.transcription import held
from vmri_jax.scene import Body, Controlled, Scene

NONE = np.zeros(0)
MARCH = vm.Solver("masses")
"""Without the exact solve behind it, which takes long to compile."""
CART = Scene([Body("cart", 1.0, [0.0], pace="slow")], [Controlled("cart", "force")])


def effort(state, u):
    return u @ u / 2


def at_rest_at_one(state):
    return jnp.concatenate([state.q_s - 1.0, state.q_f - 1.0, state.p_s, state.p_f])


@cache
def least(steps: int = 20, goal=at_rest_at_one, **asked):
    """The cart moved by one in one second; each search is made once."""
    how: dict[str, Any] = {"scheme": vm.fully_explicit(1), "macro_dt": 1 / steps, "num_steps": steps}
    return minimize(CART, effort, goal=goal, **how | asked)


def test_a_double_integrator():
    """u = 6 - 12 t, J = 6 and one iteration, since the problem is linear; the multipliers (-12, 6) are minus the
    derivatives of ``J = 6 x^2 - 6 x p + 2 p^2`` with respect to the position x and the momentum p of the goal."""
    optimum = least()
    assert optimum.success
    assert optimum.iterations <= 2
    assert optimum.miss < 1e-12
    assert optimum.trajectory.success
    assert optimum.trajectory.q_s[-1, 0] == pytest.approx(1.0, abs=1e-12)
    assert np.abs(optimum.controls[:, 0] - (6 - 12 * (optimum.t + 0.5 / 20))).max() < 6.0 / 20**2
    np.testing.assert_allclose(optimum.multipliers, [-12, 6], rtol=1.5 / 20**2)
    assert abs(optimum.cost - 6) < 12 / 20**2
    assert "converged" in str(optimum)
    run = vm.simulate(optimum.problem, vm.fully_explicit(1), macro_dt=0.05, num_steps=20)  # it moves as was found
    np.testing.assert_allclose(run.q_s, optimum.trajectory.q_s, atol=1e-13)
    np.testing.assert_allclose(run.p_s[-1], optimum.trajectory.p_s[-1], atol=1e-13)


def miss(state):
    return 3 * jnp.sum((state.q_s - 1.0) ** 2) / 2


def test_a_final_cost_instead_of_a_goal():
    """The least of ``int u^2 / 2 + 3 (x(1) - 1)^2 / 2`` is ``x(1) = 3 W / (1 + 3 W)`` and ``J = 3 / 2 / (1 + 3 W)``,
    with the sum ``W = sum_k H (1 - t_k)^2`` over the middles t_k of the intervals, exact for controls that are constant
    in them.

    The forces of controls choose the matrix: without forces `galerkin` takes modes, which a system with them does not
    have.
    """
    steps = {"macro_dt": 1 / 20, "num_steps": 20}
    optimum = minimize(CART, effort, final_cost=miss, scheme=vm.galerkin(1, 2), **steps)
    W = np.mean((1 - (np.arange(20) + 0.5) / 20) ** 2)
    assert optimum.success
    assert optimum.trajectory.q_s[-1, 0] == pytest.approx(3 * W / (1 + 3 * W), rel=1e-12)
    assert optimum.cost == pytest.approx(1.5 / (1 + 3 * W), rel=1e-12)


STIFFNESS, TIPS = np.array([4.0, 9.0]), np.array([0.1, 0.05])


def springs(q_s, q_f, params):
    return jnp.sum(params["stiffness"] * (q_f["tips"] - q_s["hub"]) ** 2) / 2


def weight(t, q_s, q_f, v_s, v_f, params):
    return {"hub": -t * jnp.ones(1)}, {"tips": 0 * q_f["tips"]}


def push_the_hub(q_s, q_f, u, params):
    return {"hub": u * jnp.ones(1)}, {"tips": 0 * q_f["tips"]}


def test_a_hub_with_flexible_modes():
    """From t = 2 on, under the force -t, by dictionaries and a composition: ``u* = B^T exp(A^T (T - s)) W^-1 d``, with
    what the motion without controls misses, d, and half of ``d . W^-1 d`` as its cost."""
    masses = vm.ConstantMass(slow={"hub": [1.0]}, fast={"tips": TIPS})
    system = vm.System(masses, springs, force=weight, params={"stiffness": jnp.asarray(STIFFNESS)})
    problem = vm.Problem(system, q_s={"hub": [0.0]}, q_f={"tips": [0.0, 0.0]}, t=2.0)
    steps = {"scheme": vm.compose(vm.fully_explicit(1), "suzuki4"), "macro_dt": 0.025, "num_steps": 40}
    optimum = minimize(problem, effort, actuate=push_the_hub, num_controls=1, goal=at_rest_at_one, **steps)
    stiffness = np.zeros((3, 3))
    for i, k in enumerate(STIFFNESS):
        stiffness[np.ix_([0, i + 1], [0, i + 1])] += k * np.array([[1, -1], [-1, 1]])
    A = np.block([[np.zeros((3, 3)), np.eye(3)], [-stiffness / np.append(1.0, TIPS)[:, None], np.zeros((3, 3))]])
    B = np.eye(6)[3]
    W, _ = quad_vec(lambda s: np.outer(expm(A * s) @ B, expm(A * s) @ B), 0.0, 1.0, epsabs=1e-13)
    free, _ = quad_vec(lambda s: expm(A * (1 - s)) @ B * -(2.0 + s), 0.0, 1.0, epsabs=1e-13)
    d = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]) - free
    at_end = np.linalg.solve(W, d)
    expected = [(expm(A.T * (3.0 - t - 0.0125)) @ at_end)[3] for t in optimum.t]
    assert optimum.success
    assert optimum.trajectory.q_s["hub"][-1] == pytest.approx(1.0, abs=1e-9)
    assert optimum.cost == pytest.approx(float(d @ at_end / 2), rel=5e-2)
    assert np.abs(optimum.controls[:, 0] - expected).max() < 0.08 * np.abs(expected).max()


def push(q_s, q_f, u, params):
    return u, 0 * q_f


def test_a_cart_with_a_pendulum_from_rest_to_rest():
    """Under a constraint, with controls on the micro grid; the bob hangs still at the end."""

    def there(state):
        return jnp.concatenate([state.q_s - 0.5, state.q_f[:1] - 0.5, state.p_s, state.p_f[:1]])

    problem = cart()
    system = problem.system.replace(params={"stiffness": 0.0}, slow_potential=lambda q_s, q_f, params: 9.81 * q_f[1])
    how: dict[str, Any] = {"actuate": push, "num_controls": 1, "scheme": vm.fully_explicit(2), "solver": MARCH}
    steps: dict[str, Any] = {"macro_dt": 0.1, "num_steps": 12, "grid": "micro"}
    optimum = minimize(vm.Problem(system, problem.q_s, problem.q_f), effort, goal=there, **how, **steps)
    assert optimum.success
    assert optimum.controls.shape == (12, 2, 1)
    assert optimum.t.shape == (12, 2)
    assert optimum.miss < 1e-8
    assert np.abs(optimum.trajectory.constraint_residual).max() < 1e-10
    assert optimum.trajectory.q_f[-1] == pytest.approx([0.5, -0.5], abs=1e-6)


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
    found = least(bounds=(-4.5, 4.5))
    assert found.success
    assert np.abs(found.controls).max() <= 4.5 + 1e-9
    assert abs(found.cost - cost_with_bounds(4.5)) < 12 / 20**2


def test_a_limit_of_speed():
    """Parabolas of speed up to the limit V and down: their time is 3/2 (1 - 1/V), the cost 4 V^2 / 3 over it."""
    limit = 1.2
    found = least(40, limits=lambda state, u: state.p_s - limit)
    assert found.success
    assert np.asarray(found.trajectory.p_s).max() == pytest.approx(limit, abs=1e-8)
    assert found.cost == pytest.approx(4 * limit**2 / (4.5 * (1 - 1 / limit)), rel=4e-3)


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
    """Of half as many steps."""
    cold = least(bounds=(-4.5, 4.5))
    means, nodes = cold.controls.reshape(10, 2, 1).mean(axis=1), cold.trajectory[::2]
    fine = least(bounds=(-4.5, 4.5), start=replace(cold, controls=means, t=cold.t[::2], trajectory=nodes))
    assert fine.history[0]["update"] < cold.history[0]["update"]
    assert fine.cost == pytest.approx(cold.cost, rel=1e-9)


KICKS: dict[str, Any] = {
    "kinetic": vm.micro(vm.quadrature.midpoint),
    "slow": vm.macro(vm.quadrature.trapezoidal),
    "fast": vm.micro(vm.quadrature.trapezoidal),
}
POINT = vm.Problem(vm.System(vm.ConstantMass([1.0], NONE)), [0.0], NONE)
BY_ARRAY = vm.Problem(vm.System(vm.ConstantMass([1.0], NONE), params=jnp.ones(2)), [0.0], NONE)


@pytest.mark.parametrize(
    ("message", "options"),
    [
        ("actuate returns", {"actuate": lambda q_s, q_f, u, params: (u[:0], q_f)}),
        (
            r"actuate is <lambda>\(u, q_s, q_f, params\); it is called",
            {"actuate": lambda u, q_s, q_f, params: (u, q_f)},
        ),
        (r"cost is <lambda>\(state\); it is called with \(state, u\)", {"cost": lambda state: state.q_s @ state.q_s}),
        ("cost has shape", {"cost": lambda state, u: u}),
        ("cost cannot be traced", {"cost": lambda state, u: float(u[0])}),
        (r"cost has \(shape \(\)", {"cost": lambda state, u: (u @ u, u @ u)}),
        ("final_cost has shape", {"final_cost": lambda state: state.q_s}),
        (r"goal has shape \(\); it must be a vector", {"goal": lambda state: state.q_s[0]}),
        ("grid is 'fine'", {"grid": "fine"}),
        # The cost of such an optimum was a tenth of the least cost: a force in an interval of large weight costs
        # little.
        ("weigh each control", {"grid": "micro", "scheme": vm.compose(vm.fully_explicit(4), "suzuki4")}),
        # Micro steps beyond the macro step take controls of its neighbours in a run: the goal was missed by 1e-4.
        ("weigh each control", {"scheme": vm.compose(vm.fully_explicit(4), "yoshida4")}),
        ("weigh each control", {"scheme": vm.Scheme(1, **KICKS, force=vm.micro(vm.quadrature.left))}),
        ("weigh each", {"grid": "micro", "scheme": vm.Scheme(4, **KICKS, force=vm.macro(vm.quadrature.midpoint))}),
        ("num_controls is 0", {"num_controls": 0}),
        (r"start has shape \(3,\); the controls have \(10, 1\)", {"start": [1.0, 2.0, 3.0]}),
        ("tolerance", {"tolerance": -1.0}),
        ("derivatives of cost, the steps or the goal are not finite", {"cost": lambda state, u: jnp.sqrt(u @ u)}),
        ("the second derivative of cost in u is not positive", {"cost": lambda state, u: u[0]}),
        ("derivatives of limits are not finite", {"limits": lambda state, u: jnp.log(state.q_s - 2.0)}),
        ("give a dict, or None", {"system": BY_ARRAY}),
        ("bounds is 3.0; give", {"bounds": 3.0}),
        ("must be below the largest", {"bounds": (1.0, -1.0)}),
        ("bounds have shapes", {"bounds": ([1.0, 2.0], 3.0)}),
        (r"limits has shape \(\); it must be a vector", {"limits": lambda state, u: state.q_s[0]}),
        ("actuate is given, and the scene", {"system": CART}),
        ("num_controls is 2; the scene has 1", {"system": CART, "actuate": None, "num_controls": 2}),
        (
            "nothing is controlled; give a scene with Controlled effects",
            {"system": Scene([Body("cart", 1.0, [0.0])]), "actuate": None, "num_controls": None},
        ),
    ],
)
def test_bad_input(message, options):
    how = {
        "system": POINT,
        "actuate": push,
        "cost": effort,
        "num_controls": 1,
        "scheme": vm.fully_explicit(1),
    } | options
    with pytest.raises((vm.Refused, RuntimeError), match=message):
        minimize(how.pop("system"), how.pop("cost"), **how, macro_dt=0.1, num_steps=10)


def test_a_start_of_another_duration():
    with pytest.raises(vm.Refused, match="start is an Optimum of duration 1; num_steps macro steps last 2"):
        least(start=least(), macro_dt=0.1)


def test_a_border_has_the_mean_of_its_controls():
    u = np.array([[1.0], [5.0]])
    for t, control in ((2.1, 1.0), (2.5, 3.0), (2.5 + 1e-9, 3.0), (2.9, 5.0), (1.0, 1.0), (9.0, 5.0)):
        assert held(t, u, 2.0, 0.5)[0] == pytest.approx(control)

"""Optimal control against solutions that are known, and under constraints."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.linalg import expm

import vmri_jax as vm
from tests.user_systems import cart
from vmri_jax.control import minimize
from vmri_jax.control.transcription import held

NONE = np.zeros(0)


def point_of(strength: float) -> vm.Problem:
    """A point on a straight line, moved by a force of this strength."""
    return vm.Problem(vm.System(vm.ConstantMass([1.0], NONE), params={"strength": strength}), [0.0], NONE)


POINT = point_of(1.0)
MARCH = vm.Solver("masses")
"""Without the exact solve behind it, which takes long to compile."""
STIFFNESS = np.array([4.0, 9.0])
TIPS = np.array([0.1, 0.05])


def push(q_s, q_f, u, params):
    return u, 0 * q_f


def effort(state, u):
    return u @ u / 2


def at_rest_at_one(state):
    return jnp.concatenate([state.q_s - 1.0, state.q_f - 1.0, state.p_s, state.p_f])


def pull(q_s, q_f, u, params):
    return params["strength"] * u, 0 * q_f


def point(steps: int, strength: float = 1.0, goal=at_rest_at_one, **options):
    return minimize(
        point_of(strength),
        effort,
        actuate=pull,
        num_controls=1,
        goal=goal,
        scheme=vm.fully_explicit(1),
        macro_dt=1 / steps,
        num_steps=steps,
        **options,
    )


def test_a_double_integrator():
    """u = 6 - 12 t, J = 6, multipliers (-12, 6), and one iteration, since the problem is linear; `test_bounded` has the order."""
    steps = 10
    optimum = point(steps)
    assert optimum.success
    assert optimum.iterations <= 2
    assert optimum.miss < 1e-12
    assert optimum.trajectory.success
    assert optimum.trajectory.q_s[-1, 0] == pytest.approx(1.0, abs=1e-12)
    middle = optimum.t + 0.5 / steps
    assert np.abs(optimum.controls[:, 0] - (6 - 12 * middle)).max() < 6.0 / steps**2
    np.testing.assert_allclose(optimum.multipliers, [-12, 6], rtol=1.5 / steps**2)
    assert abs(optimum.cost - 6) < 12 / steps**2
    assert "converged" in str(optimum)


def miss(state):
    return 3 * jnp.sum((state.q_s - 1.0) ** 2) / 2


def test_a_final_cost_instead_of_a_goal():
    """The least of ``int u^2 / 2 + 3 (x(1) - 1)^2 / 2`` is ``x(1) = 3 W / (1 + 3 W)`` and ``J = 3 / 2 / (1 + 3 W)``, with the sum
    ``W = sum_k H (1 - t_k)^2`` over the middles t_k of the intervals, exact for controls that are constant in them."""
    steps = 10
    optimum = point(steps, goal=None, final_cost=miss)
    W = np.mean((1 - (np.arange(steps) + 0.5) / steps) ** 2)
    assert optimum.success
    assert optimum.trajectory.q_s[-1, 0] == pytest.approx(3 * W / (1 + 3 * W), rel=1e-12)
    assert optimum.cost == pytest.approx(1.5 / (1 + 3 * W), rel=1e-12)


def springs(q_s, q_f, params):
    return jnp.sum(params["stiffness"] * (q_f - q_s[0]) ** 2) / 2


HUB = vm.Problem(
    vm.System(vm.ConstantMass([1.0], TIPS), slow_potential=springs, params={"stiffness": jnp.asarray(STIFFNESS)}),
    [0.0],
    [0.0, 0.0],
)


def gramian_solution() -> tuple[float, np.ndarray, np.ndarray]:
    """Least cost and multiplier of the hub with its tips: ``J = z_T . W^-1 z_T / 2``, and A."""
    mass = np.diag([1.0, *TIPS])
    stiffness = np.zeros((3, 3))
    for i, k in enumerate(STIFFNESS):
        stiffness[np.ix_([0, i + 1], [0, i + 1])] += k * np.array([[1, -1], [-1, 1]])
    A = np.block([[np.zeros((3, 3)), np.eye(3)], [-np.linalg.solve(mass, stiffness), np.zeros((3, 3))]])
    B = np.zeros(6)
    B[3] = 1.0
    end = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    W, _ = quad_vec(lambda s: np.outer(expm(A * s) @ B, expm(A * s) @ B), 0.0, 1.0, epsabs=1e-13)
    at_end = np.linalg.solve(W, end)
    return float(end @ at_end / 2), at_end, A


def test_a_hub_with_flexible_modes():
    """u* = B^T exp(A^T (T - t)) W^-1 z_T, with the cost of it to second order in the step."""
    cost, at_end, A = gramian_solution()
    steps = 80
    optimum = minimize(
        HUB,
        effort,
        actuate=push,
        num_controls=1,
        goal=at_rest_at_one,
        scheme=vm.fully_explicit(1),
        macro_dt=1 / steps,
        num_steps=steps,
    )
    assert abs(optimum.cost - cost) / cost < 1.2e-2  # measured 1.16e-2
    expected = [(expm(A.T * (1 - t - 0.5 / steps)) @ at_end)[3] for t in optimum.t]
    assert np.abs(optimum.controls[:, 0] - expected).max() < 0.02 * np.abs(expected).max()


def test_a_cart_with_a_pendulum_from_rest_to_rest():
    """Under a constraint, with controls on the micro grid; the bob hangs still at the end."""

    def there(state):
        return jnp.concatenate([state.q_s - 0.5, state.q_f[:1] - 0.5, state.p_s, state.p_f[:1]])

    problem = cart()
    problem = vm.Problem(
        problem.system.replace(params={"stiffness": 0.0}, slow_potential=gravity), problem.q_s, problem.q_f
    )
    optimum = minimize(
        problem,
        effort,
        actuate=push,
        num_controls=1,
        goal=there,
        scheme=vm.fully_implicit(2),
        macro_dt=0.1,
        num_steps=12,
        grid="micro",
        solver=MARCH,
    )
    assert optimum.success
    assert optimum.controls.shape == (12, 2, 1)
    assert optimum.t.shape == (12, 2)
    assert optimum.miss < 1e-8
    assert np.abs(optimum.trajectory.constraint_residual).max() < 1e-10
    assert optimum.trajectory.q_f[-1] == pytest.approx([0.5, -0.5], abs=1e-6)


def gravity(q_s, q_f, params):
    return 9.81 * q_f[1]


def test_a_goal_out_of_reach_is_said():
    optimum = point(10, strength=0.0, max_iterations=3)
    assert not optimum.success
    assert optimum.miss == pytest.approx(1.0)
    assert "not converged: the best that was found; goal missed by 1.0e+00" in str(optimum)


def wrong(q_s, q_f, u, params):
    return u[:0], q_f


def weight(t, q_s, q_f, v_s, v_f, params):
    return {"x": -q_s["x"] - t}, {}


def pull_by_name(q_s, q_f, u, params):
    return {"x": u * (1 + 0 * q_s["x"])}, {}


def test_a_problem_with_dictionaries_and_a_force():
    """``x'' = u - x - t`` from t = 2 on: the controls of the same system by vectors, and a trajectory that reaches the goal."""
    masses = vm.ConstantMass(slow={"x": 1.0}, fast={})
    problem = vm.Problem(vm.System(masses, force=weight), q_s={"x": 0.0}, q_f={}, t=2.0)
    steps = {"scheme": vm.compose(vm.fully_explicit(1), "suzuki4"), "macro_dt": 0.05, "num_steps": 20}
    goal = {"goal": lambda state: jnp.concatenate([state.q_s - 1.0, state.p_s]), "num_controls": 1}
    optimum = minimize(problem, effort, actuate=pull_by_name, **goal, **steps)
    assert optimum.success
    assert optimum.trajectory.q_s["x"][-1] == pytest.approx(1.0, abs=1e-9)
    # u = B^T exp(A^T (T - s)) W^-1 d, with the miss d of the motion without controls: x = 2 cos s + sin s - 2 - s
    A, middle = np.array([[0.0, 1.0], [-1.0, 0.0]]), optimum.t - 2.0 + 0.025
    W, _ = quad_vec(lambda s: np.outer(expm(A * s)[:, 1], expm(A * s)[:, 1]), 0.0, 1.0)
    free = np.array([2 * np.cos(1.0) + np.sin(1.0) - 3.0, -2 * np.sin(1.0) + np.cos(1.0) - 1.0])
    at_end = np.linalg.solve(W, np.array([1.0, 0.0]) - free)
    expected = np.array([expm(A * (1 - s))[:, 1] @ at_end for s in middle])
    np.testing.assert_allclose(optimum.controls[:, 0], expected, atol=0.03)


KICKS: dict[str, Any] = {
    "kinetic": vm.micro(vm.quadrature.midpoint),
    "slow": vm.macro(vm.quadrature.trapezoidal),
    "fast": vm.micro(vm.quadrature.trapezoidal),
}


@pytest.mark.parametrize(
    ("message", "options"),
    [
        ("actuate returns", {"actuate": wrong}),
        (
            r"actuate is <lambda>\(u, q_s, q_f, params\); it is called",
            {"actuate": lambda u, q_s, q_f, params: (u, q_f)},
        ),
        (r"cost is <lambda>\(state\); it is called with \(state, u\)", {"cost": lambda state: state.q_s @ state.q_s}),
        ("cost has shape", {"cost": lambda state, u: u}),
        (r"cost has \(shape \(\)", {"cost": lambda state, u: (u @ u, u @ u)}),
        ("final_cost has shape", {"final_cost": lambda state: state.q_s}),
        (r"goal has shape \(\); it must be a vector", {"goal": lambda state: state.q_s[0]}),
        ("grid is 'fine'", {"grid": "fine"}),
        # The cost of such an optimum was a tenth of the least cost: a force in an interval of large weight costs little.
        ("weigh each control", {"grid": "micro", "scheme": vm.compose(vm.fully_explicit(4), "suzuki4")}),
        # Micro steps beyond the macro step take controls of its neighbours in a run: the goal was missed by 1e-4.
        ("weigh each control", {"scheme": vm.compose(vm.fully_explicit(4), "yoshida4")}),
        ("weigh each control", {"scheme": vm.Scheme(1, **KICKS, force=vm.micro(vm.quadrature.left))}),
        (
            "weigh each control",
            {"grid": "micro", "scheme": vm.Scheme(4, **KICKS, force=vm.macro(vm.quadrature.midpoint))},
        ),
        ("num_controls is 0", {"num_controls": 0}),
        (r"start has shape \(3,\); the controls have \(10, 1\)", {"start": [1.0, 2.0, 3.0]}),
        ("tolerance", {"tolerance": -1.0}),
        ("derivatives of cost, the steps or the goal are not finite", {"cost": lambda state, u: jnp.sqrt(u @ u)}),
        ("the second derivative of cost in u is not positive", {"cost": lambda state, u: u[0]}),
    ],
)
def test_bad_input(message, options):
    given = {
        "actuate": push,
        "cost": effort,
        "num_controls": 1,
        "scheme": vm.fully_explicit(1),
        "macro_dt": 0.1,
        "num_steps": 10,
    }
    with pytest.raises((ValueError, RuntimeError), match=message):
        minimize(POINT, **(given | options))


def test_params_must_be_a_dict():
    system = vm.System(vm.ConstantMass([1.0], NONE), params=jnp.ones(2))
    with pytest.raises(TypeError, match="give a dict, or None"):
        minimize(
            vm.Problem(system, [0.0], NONE),
            effort,
            actuate=push,
            num_controls=1,
            scheme=vm.fully_explicit(1),
            macro_dt=0.1,
            num_steps=10,
        )


def test_a_border_has_the_mean_of_its_controls():
    u = jnp.array([[1.0], [5.0]])
    for t, control in ((2.1, 1.0), (2.5, 3.0), (2.5 + 1e-9, 3.0), (2.9, 5.0), (1.0, 1.0), (9.0, 5.0)):
        assert held(t, u, 2.0, 0.5)[0] == pytest.approx(control)

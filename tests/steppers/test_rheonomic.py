"""Constraints that depend on time: pendulums on pivots that are moved, against their equations in angles."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import vmri_jax as vm
from benchmarks.gail2014.dense import named
from vmri_jax.diagnostics import fit_order
from vmri_jax.stability import monodromy
from vmri_jax.steppers.solver import Solver

LENGTH, G = 0.5, 9.81
PARAMS = {"amplitude": 0.3, "frequency": 4.0}
T_END = 1.0


def pivot(t, params):
    return params["amplitude"] * jnp.cos(params["frequency"] * t)


def weight(q_s, q_f, params):
    return G * q_f[1]


def spring(q_s, q_f, params):
    return weight(q_s, q_f, params) + 20.0 * q_s[0] ** 2


def guided(t, q_s, params):
    return q_s - pivot(t, params)


def rod(q_s, q_f, params):
    return (jnp.sum((q_f - jnp.append(q_s, 0.0)) ** 2, keepdims=True) - LENGTH**2) / 2


def guided_rod(t, q_s, q_f, params):
    return rod(jnp.atleast_1d(pivot(t, params)), q_f, params)


def shifted_rod(t, q_s, q_f, params):
    return rod(q_s + pivot(t, params), q_f, params)


MASSES = vm.ConstantMass([3.0], [1.0, 1.0])
SYSTEMS = {
    "cart that is moved": vm.System(MASSES, weight, None, rod, vm.Rheonomic(guided), params=PARAMS),
    "pivot that is moved": vm.System(MASSES, spring, None, vm.Rheonomic(guided_rod), params=PARAMS),
    "pivot on a sprung cart": vm.System(MASSES, spring, None, vm.Rheonomic(shifted_rod), params=PARAMS),
}


def start(system):
    """Hanging at rest in space, but for what the constraints move."""
    x = PARAMS["amplitude"]
    q_s = jnp.array([x if system.slow_constraint else 0.0])
    zero = jnp.zeros(1)
    return vm.initial_state(system, q_s, jnp.array([x, -LENGTH]), zero, jnp.array([0.4, 0.0]))


@cache
def bob(t: float) -> np.ndarray:
    """``l phi'' = -g sin phi - x'' cos phi`` of the bob at ``(x + l sin phi, -l cos phi)``."""
    amplitude, frequency = PARAMS["amplitude"], PARAMS["frequency"]

    def rate(t, y):
        pull = amplitude * frequency**2 * np.cos(frequency * t)  # -x''
        return [y[1], (-G * np.sin(y[0]) + pull * np.cos(y[0])) / LENGTH]

    phi = solve_ivp(rate, (0, t), [0.0, 0.4 / LENGTH], method="DOP853", rtol=1e-13, atol=1e-13).y[0, -1]
    return np.array([amplitude * np.cos(frequency * t) + LENGTH * np.sin(phi), -LENGTH * np.cos(phi)])


def run(system, scheme, num_steps, **options):
    return vm.simulate(system, scheme, start(system), macro_dt=T_END / num_steps, num_steps=num_steps, **options)


CASES = [
    pytest.param("cart that is moved", vm.fully_implicit(3), (20, 40), marks=pytest.mark.full),
    ("cart that is moved", vm.galerkin(2, 2), (10, 20)),
    pytest.param("pivot that is moved", vm.explicit_slow(3), (20, 40), marks=pytest.mark.full),
    ("pivot that is moved", vm.compose(vm.fully_explicit(2), "suzuki4"), (20, 40)),
]


@pytest.mark.parametrize(("name", "scheme", "steps"), CASES)
def test_order(name, scheme, steps):
    runs = [run(SYSTEMS[name], scheme, n, save=n // 10) for n in steps]
    errors = [np.abs(trajectory.q_f[-1] - bob(T_END)).max() for trajectory in runs]
    assert fit_order(1 / np.array(steps), errors).order == pytest.approx(scheme.order, abs=0.2), errors
    assert max(trajectory.constraint_residual.max() for trajectory in runs) < 1e-13  # positions and velocities


@pytest.mark.parametrize(
    ("name", "scheme", "matrix"),
    [
        ("pivot on a sprung cart", vm.galerkin(2, 2), "masses"),
        pytest.param("pivot on a sprung cart", vm.galerkin(2, 2), "dense", marks=pytest.mark.full),
        pytest.param("cart that is moved", vm.fully_implicit(3), "masses", marks=pytest.mark.full),
    ],
)
def test_all_methods_find_the_same(name, scheme, matrix):
    expected = run(SYSTEMS[name], scheme, 10, solver=Solver("exact"))
    found = run(SYSTEMS[name], scheme, 10, solver=named(matrix))
    assert np.abs(found.q_f - expected.q_f).max() < 1e-12
    assert np.abs(found.p_s - expected.p_s).max() < 1e-11


@pytest.mark.full
def test_a_step_is_symplectic():
    system = SYSTEMS["pivot on a sprung cart"]
    state = run(system, vm.fully_implicit(3), 3).final_state
    assert monodromy(system, vm.fully_implicit(3), state, macro_dt=0.05, num_steps=1).symplectic_defect < 1e-12


def test_velocities_follow_the_pivot():
    """Inconsistent velocities are projected onto ``G v + dg/dt = 0``."""
    system = SYSTEMS["cart that is moved"]
    t = 0.2
    x = float(pivot(t, PARAMS))
    with pytest.warns(UserWarning, match="all velocities are zero, but the constraints move"):
        state = vm.initial_state(system, jnp.array([x]), jnp.array([x, -LENGTH]), jnp.zeros(1), jnp.zeros(2), t)
    rate = -PARAMS["amplitude"] * PARAMS["frequency"] * np.sin(PARAMS["frequency"] * t)
    assert float(state.p_s[0]) == pytest.approx(3.0 * rate, rel=1e-14)


def test_fast_vibration_of_the_pivot_holds_a_pendulum_upright():
    """Kapitza's pendulum: upright is stable if ``(a w)^2 > 2 g l``, else it falls."""

    def up_and_down(t, q_s, q_f, params):
        height = params["amplitude"] * jnp.cos(params["frequency"] * t)
        return (jnp.sum((q_f - jnp.array([0.0, height])) ** 2, keepdims=True) - LENGTH**2) / 2

    def lowest(frequency):
        params = {"amplitude": 0.05, "frequency": frequency}
        none = np.zeros(0)
        system = vm.System(vm.ConstantMass(none, [1.0, 1.0]), weight, None, vm.Rheonomic(up_and_down), params=params)
        q_f = np.array([LENGTH * np.sin(0.1), 0.05 + LENGTH * np.cos(0.1)])
        state = vm.initial_state(system, none, q_f, none, np.zeros(2))
        return vm.simulate(system, vm.fully_explicit(1), state, macro_dt=2e-3, num_steps=3000).q_f[:, 1].min()

    border = np.sqrt(2 * G * LENGTH) / 0.05
    assert lowest(2 * border) > 0.9 * LENGTH - 0.05
    assert lowest(0.5 * border) < 0


def test_derivatives_by_parameters():
    def end(amplitude):
        system = SYSTEMS["pivot that is moved"].replace(params={"amplitude": amplitude, "frequency": 4.0})
        state = vm.initial_state(system, jnp.zeros(1), jnp.stack([amplitude, -LENGTH]), jnp.zeros(1), jnp.zeros(2))
        return vm.macro_step(system, vm.fully_explicit(1), state, 0.05, Solver("masses"))[0].q_f[0]

    # differences of the values of a program without derivatives: derivatives have equations of their own
    value, at, h = jax.jit(end), np.asarray(0.3), 1e-5
    slope = (value(at + h) - value(at - h)) / (2 * h)
    assert float(jax.jit(jax.grad(end))(at)) == pytest.approx(float(slope), rel=1e-8)


def test_stored_run_goes_on(tmp_path):
    system, scheme, solver = SYSTEMS["pivot on a sprung cart"], vm.galerkin(2, 2), Solver("masses")
    whole = run(system, scheme, 20, solver=solver)
    step = {"macro_dt": T_END / 20, "solver": solver, "out": tmp_path / "run.zarr"}
    vm.stream(system, scheme, start(system), num_steps=10, **step)
    found = vm.stream(system, scheme, start(system), num_steps=20, resume=True, **step).load()
    assert np.array_equal(found.q_f, whole.q_f)


def test_bad_input():
    with pytest.raises(TypeError, match=r"Rheonomic: function is 3.*t, q_s, q_f, params"):
        vm.Rheonomic(3)  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match=r"slow_potential is Rheonomic"):
        SYSTEMS["cart that is moved"].replace(slow_potential=vm.Rheonomic(guided))
    with pytest.raises(TypeError, match=r"slow_constraint is guided_rod\(.*\); it is called with \(t, q_s, params\)"):
        SYSTEMS["cart that is moved"].replace(slow_constraint=vm.Rheonomic(guided_rod))
    system = SYSTEMS["pivot that is moved"].replace(fast_potential=lambda q, params: jnp.sum(q**2))
    with pytest.raises(ValueError, match=r"mollified.*Rheonomic"):
        run(system, vm.mollified_impulse(3), 5)

"""The linearisation: at an equilibrium they are the derivative of the step of the system itself."""

import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests import user_systems
from tests.stability.systems import double_pendulum, hanging
from tests.support import compiled_step, phase, slopes, without_fallback
from vmri_jax.diagnostics import linearise
from vmri_jax.stability import advise, linear_model, multipliers


def step_matrix(system, scheme, state, macro_dt, motions):
    """Derivative of a macro step, in the coordinates of the small motions, by differences."""
    n_s, n = state.q_s.size, state.q_s.size + state.q_f.size
    embed, read, solver = np.asarray(motions.embed), np.asarray(motions.read), without_fallback(system, scheme, state)

    def step(coordinates):
        start = vm.State(state.t, *np.split(phase(state) + embed @ coordinates, (n_s, n, n + n_s)))
        return read @ phase(compiled_step(system, scheme, start, macro_dt, solver)[0])

    return slopes(step, np.eye(embed.shape[1]), step=1e-4)


def swinging_with_damping():
    problem = user_systems.double_pendulum()  # in angles, at rest below: a kinetic function with coupled masses
    zero = np.zeros(1)
    system = problem.system.replace(force=lambda t, q_s, q_f, v_s, v_f, params: (-3.0 * v_s, -2e-5 * v_f + 0.01 * q_f))
    return system, vm.initial_state(system, zero, zero, zero, zero)


def hanging_under_tension():
    system = double_pendulum()
    return system, hanging(system)


@pytest.mark.parametrize(
    ("case", "scheme"), [(hanging_under_tension, vm.explicit_slow(2)), (swinging_with_damping, vm.fully_implicit(2))]
)
def test_the_step_of_the_expansion_is_the_derivative_of_the_step(case, scheme):
    system, state = case()
    motions = linearise(system, state)
    values = multipliers(motions, scheme, [0.05]).values[0]
    expected = np.linalg.eigvals(step_matrix(system, scheme, state, 0.05, motions))
    assert np.abs(np.sort_complex(values) - np.sort_complex(expected)).max() < 1e-10
    assert np.abs(np.sort_complex(np.exp(0.05 * motions.rates)) - np.sort_complex(values)).max() < 0.1


def test_constraint_forces_stiffen_a_pendulum():
    """Point mass on a rod, hanging: ``omega^2 = g / l`` comes from the tension alone; standing, it grows at that
    rate."""

    def rod(q_s, q_f, params):
        return (q_f @ q_f - 4.0)[None] / 2

    def gravity(q_s, q_f, params):
        return 3 * 9.81 * q_f[1]

    system = vm.System(vm.ConstantMass([], [3.0, 3.0]), gravity, constraint=rod)
    none = np.zeros(0)
    for side in (-1.0, 1.0):
        motions = linearise(system, vm.initial_state(system, none, [0.0, 2.0 * side], none, [0.0, 0.0]))
        assert motions.stiffness == pytest.approx(-side * 9.81 / 2)
        assert motions.hessians["slow"] == pytest.approx(-side * 9.81 / 2)
        assert motions.growing == pytest.approx([np.sqrt(9.81 / 2)] if side > 0 else [])
    found = multipliers(motions, vm.fully_explicit(1), [0.05])  # of the standing pendulum
    assert found.growing.sum() == 1
    assert np.abs(found.values[found.growing]) == pytest.approx(np.exp(0.05 * motions.growing), rel=1e-3)
    assert found.radius[0] < 1
    spinning = linearise(system, vm.initial_state(system, none, [0.0, -2.0], none, [4.0, 0.0]))
    assert spinning.stiffness == pytest.approx(9.81 / 2 + 4.0**2 / 2**2)  # and the centripetal force


def test_frequencies_of_the_linear_model():
    problem = linear_model(omega=50.0, kappa=25.0)
    motions = linearise(problem)
    exact = np.sqrt(np.linalg.eigvalsh([[25.0, -25.0], [-25.0, 2525.0]]))[::-1]
    assert motions.frequencies == pytest.approx(exact)
    assert np.sort(np.abs(motions.rates))[::-2] == pytest.approx(exact)
    assert motions.frequencies_of("fast") == pytest.approx([50.0, 0.0])
    assert motions.frequencies_of("slow") == pytest.approx([np.sqrt(50.0), 0.0])


def test_multipliers_of_the_impulse_method():
    """Kicks and drifts written as matrices."""
    problem, h, n = linear_model(), 0.01, 4
    motions = linearise(problem)
    slow, fast = np.array([[25.0, -25.0], [-25.0, 25.0]]), np.diag([0.0, 2500.0])
    zero, one = np.zeros((2, 2)), np.eye(2)

    def kick(stiffness, t):
        return np.block([[one, zero], [-t * stiffness, one]])

    verlet = kick(fast, h / 2) @ np.block([[one, h * one], [zero, one]]) @ kick(fast, h / 2)
    step = kick(slow, n * h / 2) @ np.linalg.matrix_power(verlet, n) @ kick(slow, n * h / 2)
    found = multipliers(motions, vm.fully_explicit(n), [n * h])
    expected = np.linalg.eigvals(step)
    assert np.sort_complex(found.values[0]) == pytest.approx(np.sort_complex(expected), abs=1e-13)
    assert found.radius[0] == pytest.approx(np.abs(expected).max(), abs=1e-13)


def test_no_second_derivative():
    one = np.zeros(1)
    system = vm.System(vm.ConstantMass([1.0], [1.0]), lambda q_s, q_f, params: jnp.linalg.norm(q_s))
    with pytest.raises(ValueError, match=r"expansion of .*slow.* is not finite"):
        linearise(system, vm.State(0.0, one, one, one, one))


def test_nothing_moves():
    one, none = np.ones(1), np.zeros(0)
    with pytest.raises(ValueError, match="the constraints leave none of the 1 coordinates free"):
        advise(
            vm.System(vm.ConstantMass([1.0], []), slow_constraint=lambda q_s, params: q_s - 1.0),
            vm.fully_implicit(1),
            vm.State(0.0, one, none, 0 * one, none),
            macro_dt=0.1,
        )
    with pytest.raises(TypeError, match="linearise: a System has no start; give a State"):
        linearise(linear_model().system)

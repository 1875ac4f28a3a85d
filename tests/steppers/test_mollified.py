"""The mollified impulse method: V at averaged fast positions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.support import NAMES, area_change, compiled_step, largest_difference, step_matrix
from tests.user_systems import two_oscillators
from vmri_jax.diagnostics import constraint_residual, fit_order, momentum_map
from vmri_jax.schemes.quadrature import midpoint, mollified, trapezoidal
from vmri_jax.steppers.solver import Solver


@pytest.mark.parametrize("fast", [midpoint, trapezoidal], ids=["midpoint", "kicks"])
def test_average_of_a_vibration(fast):
    """``a(q) = sin(N theta) cot(theta / 2) / (2 N) q`` for the phase theta of a micro step: zero at ``N theta = k
    pi``."""
    system, n, h = two_oscillators().system, 10, 0.013
    scheme = vm.Scheme(n, kinetic=vm.micro(midpoint), slow=mollified(vm.macro(trapezoidal)), fast=vm.micro(fast))
    theta = 2 * np.arctan(50.0 * h / 2) if fast is midpoint else 2 * np.arcsin(50.0 * h / 2)
    slope = step_matrix(system, scheme, n * h)[0, 1]  # H^2 / 2 kappa a'(q): the kick of V in the end's slow position
    average = 2 * float(slope) / (25.0 * (n * h) ** 2)
    assert average == pytest.approx(np.sin(n * theta) / np.tan(theta / 2) / (2 * n), rel=1e-12)


def spectral_radius(scheme, macro_dt) -> float:
    """Of a step of the linear model of impulse resonance."""
    matrix = step_matrix(two_oscillators().system, scheme, macro_dt)
    return float(np.abs(np.linalg.eigvals(np.asarray(matrix))).max())


@pytest.mark.parametrize("shift", [-0.02, -0.005, -0.002, 0.002])
def test_first_resonance_is_gone(shift):
    """Just below ``num_micro theta = pi`` impulses by V excite the fast vibration, unless V is mollified."""
    n = 10
    macro_dt = 2 * n / 50.0 * np.tan(np.pi / (2 * n)) * (1 + shift)
    plain, filtered = (spectral_radius(make(n), macro_dt) for make in (vm.explicit_slow, vm.mollified_impulse))
    assert (plain > 1 + 1e-3) == (shift in (-0.005, -0.002)), plain
    assert filtered < 1 + 1e-9


def hardening(q_s, q_f, params):
    return params["kappa"] / 4 * jnp.sum((q_s - q_f) ** 4) + jnp.sum(q_s**2)


@pytest.fixture(scope="module")
def hardened():
    """``hardened(scheme, macro_dt, num_steps, state)``: the end of a run of two oscillators with a nonlinear
    coupling."""
    problem = two_oscillators()
    system = problem.system.replace(slow_potential=hardening)

    def end(scheme, macro_dt, num_steps, state=None):
        start = state or problem.state()
        run = vm.simulate(system, scheme, start, macro_dt=macro_dt, num_steps=num_steps, save=num_steps)
        return run.final_state

    return end


def test_order(hardened):
    steps = np.array([50, 100, 200, 400])
    ends = [hardened(vm.mollified_impulse(4), 0.5 / n, n) for n in (*steps, 3200)]
    for name in NAMES:
        errors = [largest_difference(getattr(end, name), getattr(ends[-1], name)) for end in ends[:-1]]
        assert fit_order(0.5 / steps, errors).order == pytest.approx(2.0, abs=0.2)


def test_composition_averages_over_each_stage(hardened):
    """The average depends on the length of a stage: kicks are not handed from stage to stage."""
    scheme, h, c = vm.mollified_impulse(4), 0.02, (0.5, 0.2, 0.3)
    composed, state = hardened(vm.compose(scheme, c), h, 1), None
    for part in c:
        state = hardened(scheme, part * h, 1, state)
    for a, b in zip(jax.tree.leaves(composed), jax.tree.leaves(state), strict=True):
        assert largest_difference(a, b) < 1e-13


# --- two points in the plane on a rod, the fast one at a spring to the origin ----------------------------------------
def attraction(q_s, q_f, params):
    return 3 * (q_s @ q_s) ** 2 + 5 * (q_s @ q_f) ** 2


def spring(q_f, params):
    return 400 * (jnp.linalg.norm(q_f) - 1.2) ** 2


def rod(q_s, q_f, params):
    return jnp.sum((q_f - q_s) ** 2, keepdims=True) / 2 - 0.5


DUMBBELL = vm.System(vm.ConstantMass([5.0, 5.0], [1.0, 1.0]), attraction, spring, rod)
"""Nothing of it changes under rotations."""


def dumbbell_start(x=(0.0,) * 6) -> vm.State:
    """Near (0.4, 0) and (0.4, 1), with the spring stretched; x are changes of place, angle and velocities."""
    q_s, v_s = np.array([0.4, 0.0]) + x[:2], np.array([0.0, 0.5]) + x[2:4]
    along = np.array([np.sin(x[4]), np.cos(x[4])])
    v_f = v_s + (2.0 + x[5]) * np.array([along[1], -along[0]])
    return vm.State(np.zeros(()), q_s, q_s + along, 5.0 * v_s, v_f)


def dumbbell_step(start: vm.State) -> vm.State:
    return compiled_step(DUMBBELL, vm.mollified_impulse(2), start, 0.02, Solver("masses"))[0]


def test_structure_with_constraints():
    """Symplectic, and the angular momentum is kept: averages rotate with the system."""

    def turned(q_s, q_f):
        return jnp.stack([-q_s[1], q_s[0]]), jnp.stack([-q_f[1], q_f[0]])

    def ends(x):
        start = dumbbell_start(x)
        return start, dumbbell_step(start)

    assert area_change(ends, 6) < 1e-12  # measured 1e-13
    states = [dumbbell_start()]
    for _ in range(50):
        states.append(dumbbell_step(states[-1]))
    run = jax.tree.map(lambda *a: np.stack(a), *states)
    L = jax.jit(jax.vmap(lambda s: momentum_map(turned, s.q_s, s.q_f, s.p_s, s.p_f)))(run)
    assert np.abs(L - L[0]).max() < 2e-13  # measured 2e-14
    residuals = jax.jit(jax.vmap(constraint_residual, (None, 0)))(DUMBBELL, run)
    assert float(residuals.max()) < 1e-14  # measured 5e-16


def test_evaluations_are_stated():
    assert vm.mollified_impulse(8).describe().fast_evaluations == 2 * vm.explicit_slow(8).describe().fast_evaluations


def kinetic(q_s, q_f, v_s, v_f, params):
    return (v_s @ v_s + v_f @ v_f) / 2


def test_bad_input():
    with pytest.raises(ValueError, match="give kicks at the macro nodes"):
        mollified(vm.micro(trapezoidal))
    with pytest.raises(ValueError, match="only kicks of the slow potential"):
        vm.Scheme(2, kinetic=vm.micro(midpoint), slow=vm.macro(trapezoidal), fast=mollified(vm.macro(trapezoidal)))
    with pytest.raises(ValueError, match="mollified"):
        vm.discrete_lagrangian(two_oscillators().system, vm.mollified_impulse(2))
    system = two_oscillators().system.replace(kinetic=kinetic)
    state = vm.initial_state(system, [0.0], [0.1], [0.0], [0.0])
    with pytest.raises(ValueError, match="needs a System whose kinetic is a ConstantMass"):
        vm.simulate(system, vm.mollified_impulse(2), state, macro_dt=0.1, num_steps=1)

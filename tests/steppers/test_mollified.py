"""The mollified impulse method: V at averaged fast positions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.support import compiled_step, largest_difference, relative_difference, step_matrix, without_fallback
from tests.user_systems import two_oscillators
from vmri_jax import (
    Newton,
    Scheme,
    State,
    compose,
    discrete_lagrangian,
    explicit_slow,
    initial_state,
    macro,
    micro,
    mollified_impulse,
    simulate,
)
from vmri_jax.diagnostics import momentum_map, observed_order, rotation_about, symplectic_defect
from vmri_jax.schemes.quadrature import midpoint, mollified, trapezoidal


@pytest.mark.parametrize("fast", [midpoint, trapezoidal], ids=["midpoint", "kicks"])
def test_average_of_a_vibration(fast):
    """``a(q) = sin(N theta) cot(theta / 2) / (2 N) q`` for the phase theta of a micro step: zero at ``N theta = k pi``."""
    system, n, h = two_oscillators().system, 6, 0.013
    scheme = Scheme(n, kinetic=micro(midpoint), slow=mollified(macro(trapezoidal)), fast=micro(fast))
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
    plain, filtered = (spectral_radius(make(n), macro_dt) for make in (explicit_slow, mollified_impulse))
    assert (plain > 1 + 1e-3) == (shift in (-0.005, -0.002)), plain
    assert filtered < 1 + 1e-9


def test_order(fpu):
    steps = np.array([50, 100, 200, 400])
    scheme = mollified_impulse(4)
    ends = [
        simulate(fpu.system, scheme, fpu.state(), macro_dt=0.5 / n, num_steps=n, save_every=n).final_state
        for n in (*steps, 3200)
    ]
    for name in ("q_s", "q_f", "p_s", "p_f"):
        errors = [largest_difference(getattr(end, name), getattr(ends[-1], name)) for end in ends[:-1]]
        assert observed_order(0.5 / steps, errors) == pytest.approx(2.0, abs=0.2)


def test_structure_with_constraints(tsp):
    """Symplectic, and the angular momentum about the vertical is kept: averages rotate with the system."""
    scheme = mollified_impulse(3)
    assert symplectic_defect(tsp.system, scheme, tsp.state(), 0.02, without_fallback(tsp.system, scheme)) < 1e-11
    run = simulate(tsp.system, scheme, tsp.state(), macro_dt=0.02, num_steps=100)
    L = jax.vmap(lambda *z: momentum_map(rotation_about([0.0, 0.0, 1.0]), *z))(run.q_s, run.q_f, run.p_s, run.p_f)
    assert float(jnp.abs(L - L[0]).max()) < 1e-9  # momenta of size 1000
    assert float(run.constraint_residual.max()) < 1e-12


def test_average_of_a_nonlinear_vibration_by_all_methods(tsp):
    start = tsp.state()
    q_f = start.q_f + jnp.array([0, 0, 0, 0, 0, 1e-2])  # the spring is stretched
    state = State(start.t, start.q_s, q_f, start.p_s, start.p_f)
    expected, found = (
        compiled_step(tsp.system, mollified_impulse(3), state, 0.02, Newton(method))[0]
        for method in ("arrowhead", "nested")
    )
    plain, _ = compiled_step(tsp.system, explicit_slow(3), state, 0.02, Newton("nested"))
    assert largest_difference(expected.p_f, plain.p_f) > 1e-7  # measured 7.2e-7
    for name in ("q_s", "q_f", "p_s", "p_f"):
        assert relative_difference(getattr(found, name), getattr(expected, name)) < 1e-13


def test_composition_averages_over_each_stage(fpu):
    """The average depends on the length of a stage: kicks are not handed from stage to stage."""
    scheme, h, c = mollified_impulse(3), 0.02, (0.7, -0.4, 0.7)
    state, newton = fpu.state(), without_fallback(fpu.system, scheme)
    composed, _ = compiled_step(fpu.system, compose(scheme, c), state, h, newton)
    for part in c:
        state, _ = compiled_step(fpu.system, scheme, state, part * h, newton)
    for a, b in zip(jax.tree.leaves(composed), jax.tree.leaves(state), strict=True):
        assert largest_difference(a, b) < 1e-13


def test_evaluations_are_stated():
    assert mollified_impulse(8).describe().fast_evaluations == 2 * explicit_slow(8).describe().fast_evaluations


def kinetic(q_s, q_f, v_s, v_f, params):
    return (v_s @ v_s + v_f @ v_f) / 2


def test_bad_input():
    with pytest.raises(ValueError, match="give kicks at the macro nodes"):
        mollified(micro(trapezoidal))
    with pytest.raises(ValueError, match="only kicks of the slow potential"):
        Scheme(2, kinetic=micro(midpoint), slow=macro(trapezoidal), fast=mollified(macro(trapezoidal)))
    with pytest.raises(ValueError, match="mollified"):
        discrete_lagrangian(two_oscillators().system, mollified_impulse(2))
    system = two_oscillators().system.replace(kinetic=kinetic)
    state = initial_state(system, [0.0], [0.1], [0.0], [0.0])
    with pytest.raises(ValueError, match="needs a System whose kinetic is a ConstantMass"):
        simulate(system, mollified_impulse(2), state, macro_dt=0.1, num_steps=1)

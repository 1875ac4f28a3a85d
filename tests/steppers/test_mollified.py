"""The mollified impulse method: V at averaged fast positions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from vmri_jax.steppers.step import averaging

from tests.support import compiled_step, largest_difference, without_fallback
from vmri_jax import (
    ConstantMass,
    Newton,
    Scheme,
    State,
    System,
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


def soft(q_s, q_f, params):
    return params["kappa"] / 2 * jnp.sum((q_s - q_f) ** 2)


def stiff(q_f, params):
    return params["omega"] ** 2 / 2 * jnp.sum(q_f**2)


def two_springs(kappa=25.0, omega=50.0) -> System:
    """One slow and one fast variable: the linear model of impulse resonance."""
    params = {"kappa": jnp.array(kappa), "omega": jnp.array(omega)}
    return System(ConstantMass([1.0], [1.0]), soft, stiff, params=params)


@pytest.mark.parametrize("fast", [midpoint, trapezoidal], ids=["midpoint", "kicks"])
def test_average_of_a_vibration(fast):
    """``a(q) = sin(N theta) cot(theta / 2) / (2 N) q`` for the phase theta of a micro step: zero at ``N theta = k pi``."""
    system, n, h = two_springs(), 6, 0.013
    scheme = Scheme(n, kinetic=micro(midpoint), slow=mollified(macro(trapezoidal)), fast=micro(fast))
    theta = 2 * np.arctan(50.0 * h / 2) if fast is midpoint else 2 * np.arcsin(50.0 * h / 2)
    average = averaging(system, scheme, n * h, Newton())
    assert average is not None
    a = average(jnp.zeros(1), jnp.array([0.7]))
    assert float(a[0]) == pytest.approx(0.7 * np.sin(n * theta) / np.tan(theta / 2) / (2 * n), rel=1e-12)


def spectral_radius(scheme, macro_dt) -> float:
    system = two_springs()

    def step(z):
        state, _ = compiled_step(
            system, scheme, State(0.0, *jnp.split(z, 4)), macro_dt, without_fallback(system, scheme)
        )
        return jnp.concatenate([state.q_s, state.q_f, state.p_s, state.p_f])

    return float(np.abs(np.linalg.eigvals(np.asarray(jax.jacfwd(step)(jnp.zeros(4))))).max())


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
    state = tsp.state()
    q_f = state.q_f + jnp.array([0, 0, 0, 0, 0, 1e-2])  # the spring is stretched
    expected, found = (
        averaging(tsp.system, mollified_impulse(5), 0.02, Newton(method))(state.q_s, q_f)  # pyright: ignore[reportOptionalCall]
        for method in ("arrowhead", "nested")
    )
    assert largest_difference(expected, q_f) > 1e-3
    assert largest_difference(found, expected) < 1e-13


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
        discrete_lagrangian(two_springs(), mollified_impulse(2))
    system = System(kinetic, soft, stiff, params=two_springs().params)
    state = initial_state(system, [0.0], [0.1], [0.0], [0.0])
    with pytest.raises(ValueError, match="needs a System whose kinetic is a ConstantMass"):
        simulate(system, mollified_impulse(2), state, macro_dt=0.1, num_steps=1)

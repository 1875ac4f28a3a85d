"""What the discrete flow keeps: the symplectic form, reversibility, momentum maps, constraints and the energy band."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.support import PROBLEMS, compiled_step, largest_difference, without_fallback
from vmri_jax import (
    Scheme,
    State,
    explicit_slow,
    fully_explicit,
    fully_implicit,
    galerkin,
    initial_state,
    macro,
    micro,
    quadrature,
    simulate,
)
from vmri_jax.diagnostics import momentum_map, rotation_about, symplectic_defect, translation_along

SYMMETRIC = {
    "fully implicit": fully_implicit(5),
    "explicit slow": explicit_slow(5),
    "fully explicit": fully_explicit(5),
    "simpson": Scheme(
        4, kinetic=micro(quadrature.midpoint), slow=macro(quadrature.simpson), fast=micro(quadrature.simpson)
    ),
    "gauss 2": galerkin(3, 2),
    "lobatto 3": galerkin(2, 3, "lobatto"),
}
MACRO_DT = {"fpu": 0.05, "tsp": 0.02, "sam": 0.02}


@cache
def generic_state(name):
    """A state with all momenta excited, on the constraints."""
    problem = PROBLEMS[name]()
    run = simulate(problem.system, fully_implicit(3), problem.state(), macro_dt=MACRO_DT[name], num_steps=20)
    return run.final_state


compiled_defect = jax.jit(symplectic_defect)


def defect(system, scheme, state, macro_dt):
    return compiled_defect(system, scheme, state, macro_dt, without_fallback(system, scheme))


@pytest.mark.parametrize(
    ("name", "scheme"),
    [("fpu", "fully implicit"), ("fpu", "lobatto 3"), ("tsp", "fully implicit"), ("tsp", "gauss 2")],
)
def test_step_is_symplectic(name, scheme):
    worst = defect(PROBLEMS[name]().system, SYMMETRIC[scheme], generic_state(name), MACRO_DT[name])
    assert worst < 1e-11  # measured 5e-15 (FPU), 1.2e-13 (TSP, momenta of size 100)


@pytest.mark.parametrize("name", ["fpu", "tsp"])
@pytest.mark.parametrize("scheme", [explicit_slow, fully_explicit])
def test_step_is_symplectic_for_every_alpha(name, scheme):
    system, state = PROBLEMS[name]().system, generic_state(name)
    for alpha in (0.0, 0.2, 0.5, 1.0):
        assert defect(system, scheme(5, alpha), state, MACRO_DT[name]) < 1e-11  # measured 3e-14


def test_step_is_symplectic_for_rules_that_are_not_symmetric():
    worst = defect(PROBLEMS["fpu"]().system, galerkin(3, 2, quadrature.radau(2)), generic_state("fpu"), 0.05)
    assert worst < 1e-11  # measured 3e-15


def test_a_step_that_is_not_symplectic_is_seen():
    """The measure itself: a step with a dissipative force is far off."""

    def drag(t, q_s, q_f, v_s, v_f, params):
        return -0.1 * v_s, -0.1 * v_f

    system = PROBLEMS["tsp"]().system.replace(force=drag)
    assert defect(system, fully_implicit(2), generic_state("tsp"), 0.02) > 1e-5


@pytest.mark.parametrize(
    ("name", "scheme"),
    [("fpu", "explicit slow"), ("fpu", "simpson"), ("fpu", "lobatto 3")]
    + [("tsp", s) for s in ("fully implicit", "explicit slow", "fully explicit", "gauss 2")],
)
def test_symmetric_schemes_are_reversible(name, scheme):
    system, state = PROBLEMS[name]().system, generic_state(name)

    newton = without_fallback(system, SYMMETRIC[scheme])

    def step(s):
        return compiled_step(system, SYMMETRIC[scheme], s, MACRO_DT[name], newton)[0]

    def flip(s):
        return State(s.t, s.q_s, s.q_f, -s.p_s, -s.p_f)

    there = step(state)
    back = flip(step(flip(there)))
    worst = max(largest_difference(getattr(back, k), getattr(state, k)) for k in ("q_s", "q_f", "p_s", "p_f"))
    assert largest_difference(there.q_f, state.q_f) > 1e-3
    assert worst < 1e-11  # measured 4e-16 (FPU), 2e-13 (TSP)


def test_schemes_with_one_sided_rules_are_not_reversible():
    system, state = PROBLEMS["fpu"]().system, generic_state("fpu")

    scheme = fully_explicit(5, 0.0)
    newton = without_fallback(system, scheme)

    def step(s):
        return compiled_step(system, scheme, s, 0.05, newton)[0]

    there = step(state)
    back = step(State(there.t, there.q_s, there.q_f, -there.p_s, -there.p_f))
    assert largest_difference(back.q_f, state.q_f) > 1e-5


LONG = {"fully implicit": fully_implicit(5), "explicit slow": explicit_slow(5), "fully explicit": fully_explicit(5)}


@cache
def long_run(name, scheme):
    problem = PROBLEMS[name]()
    return simulate(problem.system, LONG[scheme], problem.state(), macro_dt=0.01, num_steps=10_000, save_every=100)


@pytest.mark.parametrize("scheme", LONG)
def test_angular_momentum_of_the_pendulum_over_10000_steps(scheme):
    run = long_run("tsp", scheme)
    about_z = rotation_about([0.0, 0.0, 1.0])
    l_z = np.asarray(jax.vmap(lambda *z: momentum_map(about_z, *z))(run.q_s, run.q_f, run.p_s, run.p_f))
    assert np.abs(l_z / l_z[0] - 1).max() < 1e-12  # measured 2.4e-13


@pytest.mark.parametrize("scheme", LONG)
def test_constraints_of_the_pendulum_over_10000_steps(scheme):
    position, velocity = np.asarray(long_run("tsp", scheme).constraint_residual).max(axis=0)
    assert position < 2e-13  # measured 2.2e-14, 1e-12 wanted
    assert velocity < 2e-13  # measured 2.3e-14, 1e-10 wanted


def hanging_pendulum():
    """The triple pendulum swinging regularly, not far from hanging."""
    system = PROBLEMS["tsp"]().system
    q_s, q_f = jnp.array([3.0, 0.0, -9.5]), jnp.array([3.5, 0.5, -11.4, 3.6, 0.6, -14.4])
    v_s, v_f = jnp.array([0.0, 1.0, 0.0]), jnp.array([0.5, 1.0, 0.0, 0.0, 1.5, 0.1])
    return system, initial_state(system, q_s, q_f, v_s, v_f, project=True)


@pytest.mark.parametrize("scheme", LONG)
def test_energy_of_the_pendulum_stays_in_a_band_without_drift(scheme):
    system, state = hanging_pendulum()
    run = simulate(system, LONG[scheme], state, macro_dt=0.01, num_steps=10_000, save_every=100)
    check_band(run, ENERGY_BAND["tsp", scheme])


@pytest.mark.parametrize("scheme", LONG)
def test_energy_of_the_chain_stays_in_a_band_without_drift(scheme):
    check_band(long_run("fpu", scheme), ENERGY_BAND["fpu", scheme])


def check_band(run, largest):
    """The band of the energy, and the line fitted through it, relative to the energy at the start."""
    energy = np.asarray(run.energy) / abs(float(run.energy[0]))
    band = np.ptp(energy)
    drift = np.polyfit(np.asarray(run.t) / float(run.t[-1]), energy, 1)[0]
    assert band < largest
    assert abs(drift) < 0.2 * band  # measured 0.08


ENERGY_BAND = {  # measured: 1.1e-6, 1.6e-6, 1.6e-6; 2.9e-5, 7.7e-4, 1.5e-3
    ("tsp", "fully implicit"): 3e-6,
    ("tsp", "explicit slow"): 3e-6,
    ("tsp", "fully explicit"): 3e-6,
    ("fpu", "fully implicit"): 1e-4,
    ("fpu", "explicit slow"): 2e-3,
    ("fpu", "fully explicit"): 4e-3,
}


def only_differences(q_s, q_f, params):
    q = jnp.concatenate([q_s, q_f]).reshape(-1, 3)
    return jnp.sum(jnp.sum((q[1:] - q[:-1]) ** 2, axis=1) ** 2)


@pytest.mark.parametrize("scheme", ["explicit slow", "gauss 2"])
def test_linear_momentum_of_free_particles(scheme):
    system = PROBLEMS["tsp"]().system.replace(slow_potential=only_differences, slow_constraint=None)
    state = generic_state("tsp")
    run = simulate(system, SYMMETRIC[scheme], state, macro_dt=0.005, num_steps=200)
    along = translation_along([1.0, -2.0, 0.5])
    momentum = np.asarray(jax.vmap(lambda *z: momentum_map(along, *z))(run.q_s, run.q_f, run.p_s, run.p_f))
    moved = largest_difference(run.p_f[-1], run.p_f[0])
    assert moved > 0.01
    assert np.abs(momentum / momentum[0] - 1).max() < 1e-12

"""Forces by Lagrange-d'Alembert: damping and a time-dependent drive against closed-form solutions."""

import jax.numpy as jnp
import numpy as np
import pytest

from vmri_jax import ConstantMass, Problem, System, fully_implicit, galerkin, simulate
from vmri_jax.diagnostics import fit_order

DAMPING, SLOW, FAST, DRIVE = 0.3, 1.0, 10.0, 4.0


def slow_spring(q_s, q_f, params):
    return SLOW**2 / 2 * jnp.sum(q_s**2)


def fast_spring(q_f, params):
    return FAST**2 / 2 * jnp.sum(q_f**2)


def force(t, q_s, q_f, v_s, v_f, params):
    """Damping and drive in one function, so that cases share programs."""
    push = params["drive"] * jnp.cos(DRIVE * t)
    return push - 2 * params["damping"] * v_s, 5 * push - 2 * params["damping"] * v_f


def damped(t, omega):
    """q'' + 2 d q' + omega^2 q = 0 from q = 1, q' = 0: position and velocity."""
    w = np.sqrt(omega**2 - DAMPING**2)
    decay = np.exp(-DAMPING * t)
    return decay * (np.cos(w * t) + DAMPING / w * np.sin(w * t)), -decay * omega**2 / w * np.sin(w * t)


def driven(t, omega, strength):
    """q'' + omega^2 q = strength cos(DRIVE t) from q = 1, q' = 0: position and velocity."""
    a = strength / (omega**2 - DRIVE**2)
    return (
        (1 - a) * np.cos(omega * t) + a * np.cos(DRIVE * t),
        -(1 - a) * omega * np.sin(omega * t) - a * DRIVE * np.sin(DRIVE * t),
    )


EXACT = {
    "damping": ({"damping": DAMPING, "drive": 0.0}, lambda t: (*damped(t, SLOW), *damped(t, FAST))),
    "drive": ({"damping": 0.0, "drive": 1.0}, lambda t: (*driven(t, SLOW, 1.0), *driven(t, FAST, 5.0))),
}


def problem_with(case):
    one, zero = np.ones(1), np.zeros(1)
    masses, params = ConstantMass([1.0], [1.0]), EXACT[case][0]
    system = System(masses, slow_potential=slow_spring, fast_potential=fast_spring, force=force, params=params)
    return Problem(system, one, one, zero, zero, t=0.5)


@pytest.mark.parametrize("case", EXACT)
@pytest.mark.parametrize(
    ("scheme", "steps"),
    [(fully_implicit(4), (80, 160, 320)), (galerkin(4, 2), (20, 40, 80))],
    ids=["midpoint", "gauss 2"],
)
def test_order_with_a_force(case, scheme, steps):
    exact, problem = EXACT[case][1], problem_with(case)
    if case == "drive":  # the clock starts at 0.5: shift the start onto the exact solution
        q_s, v_s, q_f, v_f = (np.array([x]) for x in exact(0.5))
        problem = Problem(problem.system, q_s, q_f, v_s, v_f, t=0.5)
    errors = []
    for n in steps:
        run = simulate(problem.system, scheme, problem.state(), macro_dt=2 / n, num_steps=n, save=n // 20)
        q_s, v_s, q_f, v_f = exact(np.asarray(run.t) - (0.5 if case == "damping" else 0.0))
        pairs = ((run.q_s, q_s), (run.p_s, v_s), (run.q_f, q_f), (run.p_f, v_f))
        errors.append([np.abs(np.asarray(a)[:, 0] - b).max() for a, b in pairs])
    observed = [fit_order(1 / np.array(steps), e).order for e in np.transpose(errors)]
    assert observed == pytest.approx([scheme.order] * 4, abs=0.2)


def test_damping_takes_energy_at_its_rate():
    run = simulate(problem_with("damping"), fully_implicit(4), macro_dt=0.05, num_steps=200, save=10)
    energy = np.asarray(run.energy)
    assert energy[-1] / energy[0] == pytest.approx(np.exp(-2 * DAMPING * 10), rel=0.2)
    assert (np.diff(energy) < 0).all()

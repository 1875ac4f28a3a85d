"""Effects against closed-form solutions: orders, energy balance, exact decay, constraints under damping."""

import numpy as np
import pytest

from tests.scene.forced_bodies import DAMPING, STIFFNESS, convergence
from tests.scene.gallery_scenes import gallery_scene
from vmri_jax import fully_implicit, galerkin, simulate
from vmri_jax.diagnostics import fit_order
from vmri_jax.scene import Body, LinearDamping, MagneticField, Scene, SpringAnchor


@pytest.mark.parametrize(("scheme", "steps"), [(fully_implicit(2), (160, 320, 640)), (galerkin(2, 2), (160, 320))])
def test_order_and_energy_balance(scheme, steps):
    errors, balances = convergence(scheme, steps)
    for found, tolerance in ((errors, 0.2), (balances, 0.3)):
        orders = {name: fit_order(1 / np.array(steps), e).order for name, e in found.items()}
        assert orders == pytest.approx(dict.fromkeys(orders, scheme.order), abs=tolerance), (orders, found)


def test_linear_damping_contracts_exactly():
    """One midpoint step contracts area by d = (A' + B) / (A + B); a modified energy decays by d in every step, to round-off.

    A = m / H + c / 2, A' = m / H - c / 2, B = H k / 4, and d = exp(-c H / m) + O(H^3).
    """
    scene = Scene([Body("body", 1.0, 1.0, pace="slow")], [SpringAnchor("body", 0.0, STIFFNESS), LinearDamping(DAMPING)])
    H = 0.1
    trajectory = simulate(scene.system(), fully_implicit(1), scene.state(), macro_dt=H, num_steps=100)
    A, B, C = 1 / H + DAMPING / 2, H * STIFFNESS / 4, 1 / H - DAMPING / 2
    step = np.array([[A - B, 1.0], [0.0, 0.0]]) / (A + B)
    step[1] = (C - B) * step[0] - np.array([C + B, 0.0])
    contraction = (C + B) / (A + B)
    assert np.linalg.det(step) == pytest.approx(contraction, rel=1e-13)
    assert contraction == pytest.approx(np.exp(-DAMPING * H), abs=DAMPING * STIFFNESS * H**3 / 3)
    a, b, c = step[1, 0], (step[1, 1] - step[0, 0]) / 2, -step[0, 1]  # J-rotated step: the form that it keeps but for d
    q, p = np.asarray(trajectory.q_s[:, 0]), np.asarray(trajectory.p_s[:, 0])
    energy = a * q**2 + 2 * b * q * p + c * p**2
    decay = energy / energy[0] / contraction ** np.arange(101)
    assert np.abs(decay - 1).max() < 1e-13  # measured 9.8e-15


@pytest.mark.parametrize(("scheme", "steps"), [(fully_implicit(1), (40, 80)), (galerkin(1, 2), (40, 80))])
def test_cyclotron_motion(scheme, steps):
    """A circle of radius m v / (Q B) at the frequency Q B / m, speed kept."""
    mass, charge, field, speed = 2.0, 3.0, 0.5, 1.2
    w, radius = charge * field / mass, mass * speed / (charge * field)
    scene = Scene([Body("ion", mass, [radius, 0.0], [0.0, -speed], pace="slow")], [MagneticField(field, charge)])
    errors = []
    for n in steps:
        step = {"macro_dt": 4.0 / n, "num_steps": n, "save": n // 20}
        trajectory = simulate(scene.system(), scheme, scene.state(), **step)
        t = np.asarray(trajectory.t)
        exact = radius * np.stack([np.cos(w * t), -np.sin(w * t)], axis=1)
        errors.append(np.abs(np.asarray(trajectory.q_s) - exact).max())
        assert np.abs(trajectory.energy / trajectory.energy[0] - 1).max() < 1e-4
    assert fit_order(1 / np.array(steps), errors).order == pytest.approx(scheme.order, abs=0.2), errors


def test_damped_run_keeps_its_constraints():
    scene = gallery_scene("triple_spherical_pendulum")
    scene = Scene(scene.bodies, (*scene.effects, LinearDamping([10.0, 0.5, 0.5])))
    trajectory = simulate(scene.system(), fully_implicit(2), scene.state(), macro_dt=0.02, num_steps=200)
    assert trajectory.constraint_residual.max() < 1e-11
    energy = np.asarray(trajectory.energy)
    assert energy[-1] < energy[0] - 100
    assert (np.diff(energy) < 1e-3).all()

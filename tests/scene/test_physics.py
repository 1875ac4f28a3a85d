"""Effects against closed-form solutions: orders, energy balance, exact decay, constraints under damping."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.scene.reference_scenes import triple_spherical_pendulum
from vmri_jax import fully_implicit, galerkin, simulate
from vmri_jax.diagnostics import observed_order
from vmri_jax.scene import (
    Body,
    Gravity,
    HarmonicDrive,
    LinearDamping,
    MagneticField,
    MovingAnchor,
    PlaneContact,
    QuadraticDrag,
    Scene,
    SpringAnchor,
)

STIFFNESS, DAMPING, DRIVE, FORCE, G, DRAG = 9.0, 0.6, 2.0, 1.5, 9.81, 0.3
T_END, SAVES = 4.0, 160


def wave(t, params):
    return FORCE / STIFFNESS * jnp.cos(params["frequency"] * t)[None]


SCENE = Scene(
    [
        Body("damped", 1.0, 1.0, pace="fast"),
        Body("driven", 1.0, 1.0, pace="slow"),
        Body("pulled", 1.0, 1.0, pace="fast"),
        Body("falling", 1.0, 0.0, -1.0, pace="slow"),
        Body("bouncing", 1.0, 1.0, pace="fast"),
    ],
    [
        SpringAnchor(["damped", "driven"], 0.0, STIFFNESS),
        LinearDamping(DAMPING, "damped"),
        HarmonicDrive("driven", FORCE, DRIVE),
        MovingAnchor("pulled", wave, STIFFNESS, {"frequency": DRIVE}),
        Gravity(G, ["falling", "bouncing"]),
        QuadraticDrag(DRAG, "falling"),
        PlaneContact(point=0.0, normal=1.0, stiffness=200.0, smoothing=0.1, bodies="bouncing"),
    ],
)


def damped(t):
    """q'' + c q' + k q = 0 from q = 1, q' = 0."""
    d = DAMPING / 2
    w = np.sqrt(STIFFNESS - d**2)
    decay = np.exp(-d * t)
    return decay * (np.cos(w * t) + d / w * np.sin(w * t)), -decay * STIFFNESS / w * np.sin(w * t)


def driven(t):
    """q'' + k q = f cos(w t) from q = 1, q' = 0."""
    w, a = np.sqrt(STIFFNESS), FORCE / (STIFFNESS - DRIVE**2)
    q = (1 - a) * np.cos(w * t) + a * np.cos(DRIVE * t)
    return q, -(1 - a) * w * np.sin(w * t) - a * DRIVE * np.sin(DRIVE * t)


def falling(t):
    """q'' = -g - c |q'| q' from q = 0, q' = -1: ``q' = -u tanh(g t / u + s)``."""
    u = np.sqrt(G / DRAG)
    s = np.arctanh(1 / u)
    return -(u**2) / G * np.log(np.cosh(G * t / u + s) / np.cosh(s)), -u * np.tanh(G * t / u + s)


EXACT = {"damped": damped, "driven": driven, "pulled": driven, "falling": falling}


def run(scheme, steps):
    step = {"macro_dt": T_END / steps, "num_steps": steps, "save_every": steps // SAVES}
    return simulate(SCENE.system(), scheme, SCENE.state(), **step)


def coordinate(trajectory, name):
    """Position and velocity of a body of mass 1."""
    part, start, _ = SCENE.places[name]
    return np.asarray(getattr(trajectory, f"q_{part}")[:, start]), np.asarray(
        getattr(trajectory, f"p_{part}")[:, start]
    )


def boole(values):
    """Integral over [0, T_END] of samples at the saved nodes; order 6."""
    weights = np.zeros(SAVES + 1)
    for i in range(0, SAVES, 4):
        weights[i : i + 5] += np.array([7, 32, 12, 32, 7]) * 2 / 45
    return T_END / SAVES * weights @ values


@pytest.mark.parametrize(("scheme", "steps"), [(fully_implicit(2), (160, 320, 640)), (galerkin(2, 2), (160, 320))])
def test_order_and_energy_balance(scheme, steps):
    system = SCENE.system()
    runs = [run(scheme, n) for n in steps]
    finest = run(scheme, 4 * steps[-1])
    errors = {name: [] for name in SCENE.by_name}
    balance = []
    for trajectory in runs:
        t = np.asarray(trajectory.t)
        for name in errors:
            exact = EXACT[name](t) if name in EXACT else coordinate(finest, name)
            found = coordinate(trajectory, name)
            errors[name].append(max(np.abs(a - b).max() for a, b in zip(found, exact, strict=True)))
        q_s, q_f, p_s, p_f = trajectory.q_s, trajectory.q_f, trajectory.p_s, trajectory.p_f  # unit masses: p is v
        f_s, f_f = jax.vmap(system.forces)(trajectory.t, q_s, q_f, p_s, p_f)
        power = np.sum(np.asarray(f_s * p_s), axis=1) + np.sum(np.asarray(f_f * p_f), axis=1)
        balance.append(abs(trajectory.energy[-1] - trajectory.energy[0] - boole(power)))
    orders = {name: observed_order(1 / np.array(steps), e) for name, e in errors.items()}
    assert orders == pytest.approx(dict.fromkeys(orders, scheme.order), abs=0.2), (orders, errors)
    assert observed_order(1 / np.array(steps), balance) == pytest.approx(scheme.order, abs=0.3), balance


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
    assert np.abs(decay - 1).max() < 1e-12  # measured 1e-14


@pytest.mark.parametrize(("scheme", "steps"), [(fully_implicit(1), (40, 80)), (galerkin(1, 2), (40, 80))])
def test_cyclotron_motion(scheme, steps):
    """A circle of radius m v / (Q B) at the frequency Q B / m, speed kept."""
    mass, charge, field, speed = 2.0, 3.0, 0.5, 1.2
    w, radius = charge * field / mass, mass * speed / (charge * field)
    scene = Scene([Body("ion", mass, [radius, 0.0], [0.0, -speed], pace="slow")], [MagneticField(field, charge)])
    errors = []
    for n in steps:
        step = {"macro_dt": 4.0 / n, "num_steps": n, "save_every": n // 20}
        trajectory = simulate(scene.system(), scheme, scene.state(), **step)
        t = np.asarray(trajectory.t)
        exact = radius * np.stack([np.cos(w * t), -np.sin(w * t)], axis=1)
        errors.append(np.abs(np.asarray(trajectory.q_s) - exact).max())
        assert np.abs(trajectory.energy / trajectory.energy[0] - 1).max() < 1e-4
    assert observed_order(1 / np.array(steps), errors) == pytest.approx(scheme.order, abs=0.2), errors


def test_damped_run_keeps_its_constraints():
    scene = triple_spherical_pendulum()
    scene = Scene(scene.bodies, (*scene.effects, LinearDamping([10.0, 0.5, 0.5])))
    trajectory = simulate(scene.system(), fully_implicit(2), scene.state(), macro_dt=0.02, num_steps=200)
    assert trajectory.constraint_residual.max() < 1e-11
    energy = np.asarray(trajectory.energy)
    assert energy[-1] < energy[0] - 100
    assert (np.diff(energy) < 1e-3).all()

"""Effects against their laws: accelerations, exact decay.

Orders with forces are in `tests/verification/test_forces.py`.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vmri_jax import fully_implicit, simulate
from vmri_jax import scene as sc
from vmri_jax.mechanics.motion import motion

STIFFNESS, DAMPING, DRIVE, PHASE, FORCE, G, DRAG = 9.0, 0.6, 2.0, 0.7, 1.5, 9.81, 0.3
CONTACT, SMOOTHING = 200.0, 0.1


def wave(t, params):
    return FORCE / STIFFNESS * jnp.cos(params["frequency"] * t)[None]


SCENE = sc.Scene(
    [
        sc.Body("damped", 1.0, 1.0, pace="fast"),
        sc.Body("driven", 1.0, 1.0, pace="slow"),
        sc.Body("pulled", 1.0, 1.0, pace="fast"),
        sc.Body("falling", 1.0, 1.0, pace="slow"),
        sc.Body("bouncing", 1.0, 1.0, pace="fast"),
    ],
    [
        sc.SpringAnchor(["damped", "driven"], 0.0, STIFFNESS),
        sc.LinearDamping(DAMPING, "damped"),
        sc.HarmonicDrive("driven", FORCE, DRIVE, PHASE),
        sc.MovingAnchor("pulled", wave, STIFFNESS, params={"frequency": DRIVE}),
        sc.Gravity(G, ["falling", "bouncing"]),
        sc.QuadraticDrag(DRAG, "falling"),
        sc.PlaneContact(point=0.0, normal=1.0, stiffness=CONTACT, smoothing=SMOOTHING, bodies="bouncing"),
    ],
)
LAWS = {
    "damped": lambda t, q, v: -STIFFNESS * q - DAMPING * v,
    "driven": lambda t, q, v: -STIFFNESS * q + FORCE * np.cos(DRIVE * t + PHASE),
    "pulled": lambda t, q, v: -STIFFNESS * q + FORCE * np.cos(DRIVE * t),
    "falling": lambda t, q, v: -G - DRAG * np.abs(v) * v,
    "bouncing": lambda t, q, v: (
        -G + CONTACT * SMOOTHING * np.log1p(np.exp(-q / SMOOTHING)) / (1 + np.exp(q / SMOOTHING))
    ),
}
"""Accelerations of bodies on a line, of unit mass, which do not touch each other."""


def test_bodies_move_by_the_laws_of_their_effects():
    system, random = SCENE.system(), np.random.default_rng(0)

    @jax.jit
    def accelerate(t, q_s, q_f, v_s, v_f):
        pull = jax.grad(lambda q_s, q_f: sum(system.all_potentials(q_s, q_f).values()), (0, 1))(q_s, q_f)
        return [f - p for f, p in zip(system.forces(t, q_s, q_f, v_s, v_f), pull, strict=True)]

    for t in random.uniform(0, 4, size=10):
        q_s, q_f, v_s, v_f = (scale * random.normal(size=n) for scale, n in ((0.5, 2), (0.5, 3), (2, 2), (2, 3)))
        q, v, a = ({"s": s, "f": f} for s, f in ((q_s, q_f), (v_s, v_f), accelerate(t, q_s, q_f, v_s, v_f)))
        for name, law in LAWS.items():
            part, i, _ = SCENE.places[name]
            np.testing.assert_allclose(a[part][i], law(t, q[part][i], v[part][i]), rtol=1e-12, err_msg=name)


def test_linear_damping_contracts_exactly():
    """One midpoint step contracts area by d = (A' + B) / (A + B); a modified energy decays by d in every step, to
    round-off.

    A = m / H + c / 2, A' = m / H - c / 2, B = H k / 4, and d = exp(-c H / m) + O(H^3).
    """
    scene = sc.Scene(
        [sc.Body("body", 1.0, 1.0, pace="slow")], [sc.SpringAnchor("body", 0.0, STIFFNESS), sc.LinearDamping(DAMPING)]
    )
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


def test_cyclotron_motion():
    """A circle of radius m v / (Q B) at the frequency Q B / m."""
    mass, charge, field, speed = 2.0, 3.0, 0.5, 1.2
    w, radius = charge * field / mass, mass * speed / (charge * field)
    scene = sc.Scene(
        [sc.Body("ion", mass, [radius, 0.0], [0.0, -speed], pace="slow")], [sc.MagneticField(field, charge)]
    )
    moved = jax.jit(motion)(scene.system(), scene.state())
    np.testing.assert_allclose(moved.v_s, [0.0, -speed], atol=1e-15)
    np.testing.assert_allclose(moved.a_s, [-(w**2) * radius, 0.0], rtol=1e-13, atol=1e-15)

"""Bodies that are damped, driven, pulled, falling with drag and bouncing, side by side in one scene, with what is exact of them."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import newton_cotes

from vmri_jax import simulate
from vmri_jax.diagnostics import energy
from vmri_jax.scene import (
    Body,
    Gravity,
    HarmonicDrive,
    LinearDamping,
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
        MovingAnchor("pulled", wave, STIFFNESS, params={"frequency": DRIVE}),
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


EFFECT_OF = {
    "damped": "linear damping",
    "driven": "harmonic drive",
    "pulled": "moving anchor",
    "falling": "quadratic drag",
    "bouncing": "plane contact",
}
EXACT = {"damped": damped, "driven": driven, "pulled": driven, "falling": falling}


def run(scheme, steps):
    step = {"macro_dt": T_END / steps, "num_steps": steps, "save": steps // SAVES}
    return simulate(SCENE.system(), scheme, SCENE.state(), **step)


def coordinate(trajectory, name):
    """Position and velocity of a body of mass 1."""
    part, start, _ = SCENE.places[name]
    return np.asarray(getattr(trajectory, f"q_{part}")[:, start]), np.asarray(
        getattr(trajectory, f"p_{part}")[:, start]
    )


def integral(values):
    """Integral over [0, T_END] of samples at the saved nodes by Newton and Cotes' rule of nine points; order 10.

    Boole's rule of order 6 is off by 2e-8 here, more than the balance of a scheme of order 4.
    """
    weights = np.zeros(SAVES + 1)
    for i in range(0, SAVES, 8):
        weights[i : i + 9] += newton_cotes(8)[0]
    return T_END / SAVES * weights @ values


def balance(trajectory, name):
    """Change of a body's energy over the run less the work of the forces on it; the bodies do not touch each other."""
    system, (part, start, _) = SCENE.system(), SCENE.places[name]
    states = {key: np.asarray(getattr(trajectory, key)) for key in ("q_s", "q_f", "p_s", "p_f")}
    force = dict(zip("sf", jax.vmap(system.forces)(trajectory.t, *states.values()), strict=True))[part]
    work = integral(np.asarray(force)[:, start] * states[f"p_{part}"][:, start])  # unit masses: p is v
    ends = {key: value[[0, 0]] for key, value in states.items()}  # the others stay where they were
    for key in (f"q_{part}", f"p_{part}"):
        ends[key][1, start] = states[key][-1, start]
    first, last = (energy(system, *(value[i] for value in ends.values())) for i in (0, 1))
    return float(last - first) - work


def convergence(scheme, steps):
    """Largest errors of position or velocity, and of the energy balance, of every body at these numbers of steps.

    Where there is no exact solution, against the same scheme with four times the most steps.
    """
    finest = run(scheme, 4 * steps[-1])
    errors, balances = ({name: [] for name in SCENE.by_name} for _ in range(2))
    for n in steps:
        trajectory = run(scheme, n)
        t = np.asarray(trajectory.t)
        for name in errors:
            exact = EXACT[name](t) if name in EXACT else coordinate(finest, name)
            pairs = zip(coordinate(trajectory, name), exact, strict=True)
            errors[name].append(max(np.abs(a - b).max() for a, b in pairs))
            balances[name].append(abs(balance(trajectory, name)))
    return errors, balances

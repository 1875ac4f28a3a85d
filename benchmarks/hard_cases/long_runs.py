"""Constraints and energy over long runs, a loose tolerance, chaos."""

from functools import partial

import jax.numpy as jnp
import numpy as np

import vmri_jax as vm
from benchmarks.hard_cases import hard_case
from vmri_jax.accuracy.companions import positions
from vmri_jax.hard_cases import Outcome
from vmri_jax.hard_cases.case import draw_energy
from vmri_jax.hard_cases.measures import (
    constraints,
    difference,
    drift_meter,
    energy,
    energy_scale,
    long_run,
    run,
    status,
)

CHAIN_DT = 0.03
METERED = 20_000
"""Steps from whose nodes the shadow energy is computed."""


def hanging_pendulum() -> vm.Problem:
    """The triple pendulum hanging at rest but for small velocities: quasi-periodic motion."""
    problem = vm.systems.triple_spherical_pendulum()
    params = {name: np.asarray(value) for name, value in problem.system.params.items()}
    l_1, l_2, l_3 = params["lengths"] + [0.0, 0.0, params["gravity"] * params["masses"][2] / params["stiffness"]]
    q_f = jnp.array([0.0, 0.0, -l_1 - l_2, 0.0, 0.0, -l_1 - l_2 - l_3])
    v_s, v_f = jnp.array([0.5, 0.3, 0.0]), jnp.array([0.5, 0.3, 0.0, 0.7, 0.4, 0.1])
    return vm.Problem(problem.system, jnp.array([0.0, 0.0, -l_1]), q_f, v_s, v_f, project=True)


def smooth_shift(trajectory: vm.Trajectory, num_steps: int, scale: float) -> float:
    """Change of the mean energy per 1e5 steps, between the halves of a run, for motion that is quasi-periodic.

    The means are weighted by ``exp(-1 / (x (1 - x)))``, x from 0 to 1: they converge faster than any power of the
    length (Das, Saiki, Sander and Yorke 2017), so that the shift is not hidden by oscillations.
    """
    e = np.asarray(trajectory.energy) / scale
    half = len(e) // 2
    x = (np.arange(half) + 0.5) / half
    weights = np.exp(-1 / (x * (1 - x)))
    return float(weights @ (e[-half:] - e[:half]) / weights.sum() / (num_steps - num_steps / 2) * 1e5)


@hard_case("constraints for long")
def constraints_for_long(full: bool) -> Outcome:
    """triple pendulum, fully_implicit, num_micro 5, H = 0.01, 1e6 steps

    position constraint below 1e-12, relative energy shift below 1e-6 per 1e5 steps; no drift seen in chaotic motion,
    nor of the shadow energy of the hanging one
    """
    steps = 1_000_000 if full else 200_000  # in fewer chaotic motion alone may move the mean by half of the band
    wild, calm = vm.systems.triple_spherical_pendulum(), hanging_pendulum()
    trajectory, regular = (long_run(problem, vm.fully_implicit(5), 0.01, steps) for problem in (wild, calm))
    position, velocity = (max(a) for a in zip(constraints(trajectory), constraints(regular), strict=True))
    change = energy(trajectory, steps, energy_scale(wild, trajectory))
    shift = smooth_shift(regular, steps, energy_scale(calm, regular))
    meter = drift_meter(calm, vm.fully_implicit(5), 0.01, METERED)
    assert meter is not None
    return Outcome(
        f"{steps:.0e} steps: |g| {position:.1e}, |G v| {velocity:.1e}; relative energy per 1e5 steps: hanging "
        f"{shift:.0e}, chaotic {change.drift:.0e} in a band of {change.band:.1e}; {METERED:.0e} steps hanging, "
        f"{meter}",
        position < 1e-12 and abs(shift) < 1e-6 and not change.drifts and not meter.drifts,
        {
            "constraint": position,
            "velocity_constraint": velocity,
            "shift_per_1e5": shift,
            "band": change.band,
            "drift_per_1e5": change.drift,
            "shadow_drift": meter.drift,
            "shadow_drift_error": meter.drift_error,
        },
        partial(draw_energy, {"": trajectory}),
    )


@hard_case("loose Newton tolerance")
def loose_tolerance(full: bool) -> Outcome:
    """FPU chain, fully_implicit, num_micro 10, H = 0.03, 1e6 steps, tolerance 1e-4, 1e-8, and 1e-12, the default

    drift shrinks with the tolerance, the default shows none
    """
    steps = 1_000_000 if full else 300_000  # in fewer chaotic motion alone may hide the drift of the loosest tolerance
    problem = vm.systems.fermi_pasta_ulam()
    changes, runs = {}, {}
    newtons = {name: vm.Solver("masses", tolerance=float(name)) for name in ("1e-4", "1e-8", "1e-12")}
    for name, solver in newtons.items():
        trajectory = long_run(problem, vm.fully_implicit(10), CHAIN_DT, steps, solver=solver)
        changes[name] = energy(trajectory, steps)
        runs[f"tolerance {name}"] = trajectory
    loose, middle, default = changes.values()
    return Outcome(
        "drift of the energy per 1e5 steps: "
        + ", ".join(f"{c.drift:.0e} ({name}: {c.share:.0%} of the band)" for name, c in changes.items()),
        loose.drifts and abs(middle.drift) < abs(loose.drift) / 3 and not default.drifts,
        {f"drift_{name}": change.drift for name, change in changes.items()},
        partial(draw_energy, runs),
    )


@hard_case("chaotic pendulum")
def chaotic_pendulum(full: bool) -> Outcome:
    """triple pendulum, upright but for 1e-3, t = 100

    constraints below 1e-12, energy error below 1 % of the fall; order 2 on t <= 1
    """
    problem = vm.systems.triple_spherical_pendulum()
    lengths = np.asarray(problem.system.params["lengths"])
    tilt = np.array([np.sin(1e-3), 0.0, np.cos(1e-3)])
    q = np.cumsum(lengths)[:, None] * tilt
    problem = vm.Problem(problem.system, jnp.asarray(q[0]), jnp.asarray(q[1:].reshape(-1)), jnp.zeros(3), jnp.zeros(6))
    scheme, t_end = vm.fully_implicit(5), 100.0 if full else 10.0
    macro_dt = 0.005
    trajectory = run(problem, scheme, macro_dt, round(t_end / macro_dt), save=10)
    scale = 2 * abs(float(trajectory.energy[0]))  # from upright to hanging
    position, change = constraints(trajectory)[0], energy(trajectory, 1, scale)
    steps, ends = 0.02 / 2.0 ** np.arange(5 if full else 4), []
    for h in steps:
        ends.append(positions(run(problem, scheme, h, round(1 / h), save=round(1 / h)))[-1])
    order = vm.diagnostics.fit_order(steps[:-2], [difference(a, ends[-1]) for a in ends[:-2]]).order
    return Outcome(
        f"t = {t_end:g}: {status(trajectory)}, |g| {position:.1e}, energy error {change.band:.1e} of the fall; order "
        f"{order:.2f} on t <= 1",
        position < 1e-12 and change.band < 1e-2 and abs(order - 2) < 0.2,
        {"constraint": position, "band": change.band, "order": order},
    )

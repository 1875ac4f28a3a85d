"""Resonances of the macro step, and slow and fast variables exchanged."""

from dataclasses import replace
from functools import partial

import numpy as np

import vmri_jax as vm
from benchmarks.hard_cases import hard_case
from benchmarks.hard_cases.systems import cubic_chain, swapped_chain
from vmri_jax.hard_cases import Outcome
from vmri_jax.hard_cases.measures import energy, long_run, status
from vmri_jax.stability import advise, linear_model, plot_stability, stability_map

FIRST_UNSTABLE = {2: 1.248, 3: 1.089, 5: 1.025, 10: 0.999, 20: 0.993}
"""omega H / pi by num_micro, of an independent prototype."""
STARTS = 9
"""Runs of a chaotic motion whose median counts."""


def advised(advice) -> str:
    """In words."""
    return "let pass" if advice.ok else "advised against"


@hard_case("impulse resonance")
def impulse_resonance(full: bool) -> Outcome:
    """linear model, kappa = 25, omega = 50, explicit_slow, omega H to 4 pi

    first unstable omega H / pi within 0.005 of 1.248 (2), 1.089 (3), 1.025 (5), 0.999 (10), 0.993 (20); advice
    """
    model = linear_model(omega=50.0, kappa=25.0)
    expected = FIRST_UNSTABLE if full else {n: FIRST_UNSTABLE[n] for n in (2, 5)}
    omega_H = np.linspace(0.05, 4 * np.pi, 250)
    found = stability_map(model, {n: vm.explicit_slow(n) for n in expected}, omega_H)
    first = {n: found.first_unstable(n) / np.pi for n in expected}
    first_window = found.windows(5)[0]
    macro_dt = (first_window.start + first_window.stop) / 2 / found.omega
    advice = advise(model, vm.explicit_slow(5), macro_dt=macro_dt)
    words = ", ".join(f"{value:.3f} ({n})" for n, value in first.items())
    return Outcome(
        f"first unstable omega H / pi (num_micro): {words}; a step in the window is {advised(advice)}",
        not advice.ok and all(abs(first[n] - expected[n]) < 0.005 for n in expected),
        {f"first_unstable_{n}": value for n, value in first.items()} | {"warned": not advice.ok},
        partial(plot_stability, {"explicit slow": found}),
    )


@hard_case("FPU at omega H = pi")
def chain_at_half_period(full: bool) -> Outcome:
    """FPU chain, H = 0.0628, num_micro 30, t = 200

    explicit_slow advised against; fully_implicit energy error below 3e-3
    """
    problem, macro_dt, num_micro = vm.systems.fermi_pasta_ulam(), 0.0628, 30
    steps = round((200 if full else 50) / macro_dt)
    implicit = long_run(problem, vm.fully_implicit(num_micro), macro_dt, steps)
    kicked = long_run(problem, vm.explicit_slow(num_micro), macro_dt, round(200 / macro_dt))
    advice = advise(problem, vm.explicit_slow(num_micro), macro_dt=macro_dt)
    error = energy(implicit, steps).band
    return Outcome(
        f"explicit_slow {advised(advice)} (it ends in {status(kicked)}); fully_implicit: largest "
        f"energy error {error:.2g} to t = {steps * macro_dt:.0f}",
        not advice.ok and implicit.success and error < 3e-3,
        {"energy_error": error, "warned": not advice.ok, "explicit_slow_failed_at": kicked.failed_at},
    )


@hard_case("implicit combination resonance")
def combination_resonance(full: bool) -> Outcome:
    """linear model, kappa = 25, fully_implicit, omega h = 0.1, num_micro 57

    growth 8.4e-4 per step found, and advised against
    """
    model, scheme, num_micro = linear_model(omega=50.0, kappa=25.0), vm.fully_implicit(57), 57
    at = 0.1 * num_micro
    found = stability_map(model, scheme, [0.99 * at, at])
    growth = found.radius[0, -1] - 1
    steps = 10_000 if full else 3_000
    e = np.asarray(long_run(model, scheme, at / 50.0, steps).energy)
    k = np.linspace(0, steps, len(e))
    measured = np.polyfit(k[len(k) // 3 :], np.log(e[len(k) // 3 :]) / 2, 1)[0]  # energies grow as squares
    advice = advise(model, scheme, macro_dt=at / 50.0)
    return Outcome(
        f"growth {growth:.2e} per step from the eigenvalues, {measured:.2e} in a run of {steps} steps; "
        f"{advised(advice)}",
        abs(growth / 8.4e-4 - 1) < 0.2 and abs(measured / growth - 1) < 0.2 and not advice.ok,
        {"growth": growth, "growth_of_run": measured, "warned": not advice.ok},
    )


@hard_case("nonlinear resonance T/3, T/4")
def nonlinear_resonance(full: bool) -> Outcome:
    """FPU chain with cubic coupling, explicit_slow, omega H = 2 pi / 3 and pi / 2, 1e5 steps

    relative energy drift below 1e-6 per step, or flagged
    """
    # the motion is chaotic: its energy wanders, and the drift is a median over starts that differ by round-off
    problem, scheme, steps = cubic_chain(), vm.explicit_slow(10), 100_000
    starts = [replace(problem, q_s=problem.q_s * (1 + k * 1e-14)) for k in range(STARTS)]
    values, said, fine = {}, [], True
    for name, phase in {"2 pi / 3": 2 * np.pi / 3, "pi / 2": np.pi / 2}.items():
        runs = [long_run(start, scheme, phase / 50.0, steps) for start in starts]
        changes = [energy(run, steps, abs(float(run.energy[0]))) for run in runs]
        failed = not all(run.success for run in runs)
        flagged = failed or not advise(problem, scheme, macro_dt=phase / 50.0).ok
        drift, band = abs(np.median([c.drift for c in changes])) / 1e5, max(c.band for c in changes)
        values |= {f"drift {name}": drift, f"band {name}": band}
        said.append(f"omega H = {name}: {drift:.0e} per step in a band of {band:.1e}{', flagged' if flagged else ''}")
        fine &= drift < 1e-6 or flagged
    return Outcome(f"relative energy drift (median of {STARTS} starts) at {'; at '.join(said)}", fine, values)


@hard_case("swapped labels")
def swapped_labels(full: bool) -> Outcome:
    """FPU chain with slow and fast variables exchanged

    bounded energy error; the advice suggests the swap
    """
    problem, scheme, macro_dt = swapped_chain(), vm.fully_implicit(10), 0.03
    steps = 100_000 if full else 10_000
    trajectory = long_run(problem, scheme, macro_dt, steps)
    band = energy(trajectory, steps, abs(float(trajectory.energy[0]))).band
    advice = advise(problem, scheme, macro_dt=macro_dt)
    suggested = any(word in str(advice).lower() for word in ("swap", "exchange"))
    return Outcome(
        f"fully_implicit, H = 0.03: {status(trajectory)}, relative energy error {band:.1e}; the swap is "
        f"{'suggested' if suggested else 'not suggested'}",
        trajectory.success and band < 0.5 and suggested,
        {"band": band, "suggested": suggested},
    )

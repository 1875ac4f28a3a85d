"""Explicit limit, large steps, mass ratios."""

import numpy as np

import vmri_jax as vm
from benchmarks.gail2014.dense import dense
from benchmarks.hard_cases import hard_case, iterations
from vmri_jax.diagnostics import step_condition
from vmri_jax.hard_cases import Outcome
from vmri_jax.hard_cases.measures import energy, run, status

EXACT = vm.Solver("exact")
"""Exact matrices, which a pass may take over from those before it: they have to converge."""
DENSE = dense()
"""Newton's iteration as textbooks have it, with the matrix of every iterate: its iterations are counted."""


@hard_case("explicit limit")
def explicit_limit(full: bool) -> Outcome:
    """FPU chain, fully_explicit, omega h = 1.9, 2.0, 2.1

    stable, marginal, and a clean error
    """
    problem, num_micro, steps = vm.systems.fermi_pasta_ulam(), 2, 20_000 if full else 5_000
    scheme = vm.fully_explicit(num_micro)  # with more micro steps omega h = 1.9 meets an impulse resonance
    below, at, beyond = (run(problem, scheme, num_micro * wh / 50.0, steps, save=20) for wh in (1.9, 2.0, 2.1))
    e = np.abs(np.asarray(below.energy - below.energy[0]))
    first, second = e[: len(e) // 2].max(), e[len(e) // 2 :].max()
    clean = beyond.result == vm.Result.NON_FINITE and not np.isfinite(beyond.energy[-1])
    return Outcome(
        f"1.9: energy error up to {first:.1f} in the first half, {second:.1f} in the second; 2.0: {status(at)}; 2.1: "
        f"{status(beyond)}, NaN from there",
        below.success and second < 2 * first and clean,
        {"first_half": first, "second_half": second, "failed_at_2.0": at.failed_at, "failed_at_2.1": beyond.failed_at},
    )


@hard_case("large macro step")
def large_macro_step(full: bool) -> Outcome:
    """FPU chain, fully_implicit, num_micro 100, H = 1 and H = 2

    at most 8 Newton iterations; H = 2 fails plainly or stays bounded
    """
    problem, scheme, steps = vm.systems.fermi_pasta_ulam(), vm.fully_implicit(100), 100 if full else 20
    one, two = (run(problem, scheme, h, steps, solver=EXACT) for h in (1.0, 2.0))
    newton = iterations(run(problem, scheme, 1.0, 20, solver=DENSE))
    passes = int(np.max(np.asarray(one.info.iterations)[:20]))
    begins_well = one.success or int(one.failed_at) >= 20
    later = "" if one.success else f", {status(one)}"
    band = energy(two, 1, float(two.energy[0])).band
    return Outcome(
        f"H = 1: {newton} iterations in 20 steps, {passes} passes of the march{later}; H = 2: {status(two)}",
        begins_well and newton <= 8 and (not two.success or band < 2),
        {"iterations": newton, "passes": passes, "failed_at_1": one.failed_at, "failed_at_2": two.failed_at},
    )


PENDULUM = vm.fully_implicit(5)


def _pendulum_run(problem: vm.Problem, macro_dt: float, num_steps: int, solver: vm.Solver = EXACT) -> vm.Trajectory:
    """With 20 saved nodes."""
    return run(problem, PENDULUM, macro_dt, num_steps, save=num_steps // 20, solver=solver)


@hard_case("large constrained step")
def large_constrained_step(full: bool) -> Outcome:
    """triple pendulum, H = 0.05 and H = 0.2

    at most 4 Newton iterations; H = 0.2 goes on or fails plainly, constraints kept
    """
    problem = vm.systems.triple_spherical_pendulum()
    steps = 400 if full else 40
    usual, large = (_pendulum_run(problem, h, steps) for h in (0.05, 0.2))
    newton = _pendulum_run(problem, 0.05, steps, DENSE)
    kept = float(np.nanmax(np.asarray(large.constraint_residual)[:, 0]))
    return Outcome(
        f"H = 0.05: {iterations(newton)} iterations, {status(usual)} in {iterations(usual)} passes; H = 0.2: "
        f"{status(large)}, constraint {kept:.1e}",
        usual.success and newton.success and iterations(newton) <= 4 and kept < 1e-10,
        {
            "iterations": iterations(newton),
            "passes": iterations(usual),
            "failed_at_0.2": int(large.failed_at),
            "constraint_0.2": kept,
        },
    )


@hard_case("mass ratios 1e4 to 1e8")
def mass_ratios(full: bool) -> Outcome:
    """triple pendulum, H = 0.01

    at most 5 Newton iterations, scaled condition below 100
    """
    values = {}
    for ratio in (1e4, 1e6, 1e8):
        problem = vm.systems.triple_spherical_pendulum(masses=(ratio, 1.0, 1.0))
        steps = 1000 if full else 100
        march, newton = (_pendulum_run(problem, 0.01, steps, way) for way in (EXACT, DENSE))
        values[f"iterations_{ratio:.0e}"] = iterations(newton) if march.success and newton.success else np.inf
        values[f"condition_{ratio:.0e}"] = step_condition(problem, PENDULUM, macro_dt=0.01)
    worst = max(v for name, v in values.items() if name.startswith("iterations"))
    condition = max(v for name, v in values.items() if name.startswith("condition"))
    return Outcome(
        f"at most {worst:.0f} iterations ({values['iterations_1e+06']:.0f} at 1e6), scaled condition {condition:.0f}",
        worst <= 5 and condition < 100,
        values,
    )

"""Cases 23 to 25: three time scales, no coupling, and the known methods that schemes reduce to."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

import vmri_jax as vm
from benchmarks.hard_cases.case import hard_case
from benchmarks.hard_cases.known_methods import apart_from, midpoint_integrator, rattle
from benchmarks.hard_cases.pictures import draw_oscillatory_energies
from benchmarks.hard_cases.systems import three_scales
from vmri_jax.hard_cases import Outcome
from vmri_jax.hard_cases.measures import difference, run, status


@hard_case(23, "three scales", draw_oscillatory_energies)
def three_time_scales(full: bool) -> Outcome:
    """FPU chain with omega = 50, 70, 5000, fully_implicit, h = 0.02, t = 50

    stable at omega_3 h = 100; I_1, I_2 within 0.05 of a resolved run
    """
    problem, omega = three_scales(), np.array([50.0, 70.0, 5000.0])
    coarse = run(problem, vm.fully_implicit(5), 0.1, 500)  # omega_3 h = 100
    fine = run(problem, vm.fully_explicit(100), 0.01, 5000, save=10)  # omega_3 h = 0.5
    actions = [np.asarray(vm.diagnostics.oscillatory_energies(omega, r.q_f, r.p_f)) for r in (coarse, fine)]
    at_end = np.abs(actions[0][-1] - actions[1][-1])
    third = actions[0][:, 2].max()
    return Outcome(
        f"omega_3 h = 100: {status(coarse)}; at t = 50 I_1, I_2 within {at_end[0]:.3f}, {at_end[1]:.3f} of the resolved run, "
        f"I_3 stays below {third:.0e}",
        coarse.success and at_end[:2].max() < 0.05 and third < 0.05,
        {"I_1": at_end[0], "I_2": at_end[1], "I_3": third},
        {"t": coarse.t, "coarse": actions[0], "fine": actions[1]},
    )


def slow_alone(q_s, q_f, params):
    """``V = sum_i s_i^4 / 4 + cos s_i``, without coupling."""
    return jnp.sum(q_s**4) / 4 + jnp.sum(jnp.cos(q_s))


@hard_case(24, "zero coupling")
def no_coupling(full: bool) -> Outcome:
    """FPU chain with V = V(q_s)

    slow motion independent of num_micro to 1e-13
    """
    problem = vm.systems.fermi_pasta_ulam()
    problem = replace(problem, system=problem.system.replace(slow_potential=slow_alone))
    steps, values = 10_000 if full else 1_000, {}
    for make in (vm.explicit_slow, vm.fully_explicit):
        runs = [run(problem, make(n), 0.03, steps, save=steps) for n in (1, 10)]
        values[make.__name__] = max(difference(runs[1].q_s, runs[0].q_s), difference(runs[1].p_s, runs[0].p_s))
    words = ", ".join(f"{name} {value:.0e}" for name, value in values.items())
    return Outcome(f"num_micro 10 against 1, {steps} steps: {words}", max(values.values()) < 1e-13, values)


@hard_case(25, "reductions")
def reductions(full: bool) -> Outcome:
    """num_micro = 1

    midpoint variational integrator, Verlet, RATTLE to 1e-12
    """
    chain, pendulum = vm.systems.fermi_pasta_ulam(), vm.systems.triple_spherical_pendulum()
    steps = 200 if full else 25
    values = {
        "midpoint": apart_from(midpoint_integrator, chain, vm.fully_implicit(1), 0.02, steps),
        "Verlet": apart_from(rattle, chain, vm.fully_explicit(1), 0.02, steps),
        "RATTLE": apart_from(rattle, pendulum, vm.fully_explicit(1), 0.005, steps),
    }
    words = ", ".join(f"{name} {value:.0e}" for name, value in values.items())
    return Outcome(f"from the known method after {steps} steps: {words}", max(values.values()) < 1e-12, values)

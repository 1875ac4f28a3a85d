"""Three time scales."""

from functools import partial

import numpy as np

import vmri_jax as vm
from benchmarks.hard_cases.case import hard_case
from benchmarks.hard_cases.pictures import draw_oscillatory_energies
from benchmarks.hard_cases.systems import three_scales
from vmri_jax.hard_cases import Outcome
from vmri_jax.hard_cases.measures import run, status


@hard_case("three scales")
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
        partial(draw_oscillatory_energies, np.asarray(coarse.t), *actions),
    )

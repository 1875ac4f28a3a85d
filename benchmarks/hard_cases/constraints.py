"""A constraint that hardly sees the fast variables."""

import numpy as np

import vmri_jax as vm
from benchmarks.hard_cases.case import hard_case, iterations
from benchmarks.hard_cases.systems import nearly_slow_constraint
from vmri_jax.hard_cases import Outcome
from vmri_jax.hard_cases.measures import constraints, refusal, run, status


@hard_case("rank-deficient fast Jacobian")
def weak_fast_jacobian(full: bool) -> Outcome:
    """g = (|q_1|^2 + eps z_2^2 - l^2)/2, eps = 1 to 1e-8, and 0

    eps >= 1e-4 converges, 0 is recognised as slow-only
    """
    macro_dt, values, said = 1e-3, {}, {}
    for eps in (1.0, 1e-2, 1e-4, 1e-6, 1e-8):
        trajectory = run(nearly_slow_constraint(eps), vm.fully_implicit(5), macro_dt, 10_000 if full else 1_000)
        values[f"constraint_{eps:.0e}"] = constraints(trajectory)[0]
        values[f"iterations_{eps:.0e}"] = iterations(trajectory)
        said[eps] = status(trajectory)
    none = refusal(nearly_slow_constraint(0.0).state)
    recognised = "row(s) [0]" in none and "slow_constraint" in none
    last = min((eps for eps in said if np.isfinite(values[f"constraint_{eps:.0e}"])), default=np.inf)
    beyond = "; ".join(f"{eps:.0e}: {word}" for eps, word in said.items() if eps < last)
    return Outcome(
        f"H = {macro_dt:g}: converges down to eps = {last:.0e}{f' ({beyond})' if beyond else ''}; 0 is "
        f"{'recognised as slow-only' if recognised else 'not recognised'}",
        last <= 1e-4 and recognised and values["constraint_1e-04"] < 1e-12,
        values,
    )

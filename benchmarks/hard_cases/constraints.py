"""Cases 8 to 10: constraints that are slow only, that hardly see the fast variables, that are redundant."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

import vmri_jax as vm
from benchmarks.hard_cases.case import hard_case, iterations
from benchmarks.hard_cases.systems import four_bar, nearly_slow_constraint
from vmri_jax.accuracy.companions import positions
from vmri_jax.hard_cases import Outcome
from vmri_jax.hard_cases.measures import constraints, difference, run, status
from vmri_jax.systems.triple_spherical_pendulum import first_rod, second_rod


def refusal(problem: vm.Problem) -> str:
    """What the start of a run says against a problem; empty if it accepts it."""
    try:
        problem.state()
    except ValueError as error:
        return str(error)
    return ""


def both_rods(q_s, q_f, params):
    """Both rods of the triple pendulum, the first of which only sees slow variables."""
    return jnp.concatenate([first_rod(q_s, params), second_rod(q_s, q_f, params)])


@hard_case(8, "slow-only constraint on micro nodes")
def slow_only_constraint(full: bool) -> Outcome:
    """triple pendulum, first rod passed as `constraint`

    refused with the row, the reason (rank deficit r (num_micro - 1) per row) and the fix
    """
    problem = vm.systems.triple_spherical_pendulum()
    system = problem.system.replace(constraint=both_rods, slow_constraint=None)
    said = refusal(replace(problem, system=system, names=None))
    parts = {
        "row": "row(s) [0]",
        "reason": "rank deficit r (num_micro - 1) per row",
        "fix": "System(slow_constraint=...)",
    }
    found = {name: text in said for name, text in parts.items()}
    words = ", ".join(name for name, there in found.items() if there)
    return Outcome(f"refused, with {words}" if said else "not refused", all(found.values()), found)


@hard_case(9, "rank-deficient fast Jacobian")
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
    none = refusal(nearly_slow_constraint(0.0))
    recognised = "row(s) [0]" in none and "slow_constraint" in none
    last = min((eps for eps in said if np.isfinite(values[f"constraint_{eps:.0e}"])), default=np.inf)
    beyond = "; ".join(f"{eps:.0e}: {word}" for eps, word in said.items() if eps < last)
    return Outcome(
        f"H = {macro_dt:g}: converges down to eps = {last:.0e}{f' ({beyond})' if beyond else ''}; 0 is "
        f"{'recognised as slow-only' if recognised else 'not recognised'}",
        last <= 1e-4 and recognised and values["constraint_1e-04"] < 1e-12,
        values,
    )


@hard_case(10, "redundant constraints")
def redundant_constraints(full: bool) -> Outcome:
    """four-bar linkage with its coupler given twice

    positions equal to 1e-10 with and without, or a refusal that names the rows
    """
    once, twice = (four_bar(angle=-1.0, kappa=20.0, redundant=redundant) for redundant in (False, True))
    if said := refusal(twice):
        named = "rows [1, 3]" in said
        words = f"refused, rows {'named' if named else 'not named'}: {said.partition(' in the ')[0]}"
        return Outcome(words, named, {"named": named})
    runs = [run(problem, vm.fully_implicit(5), 0.05, 1000 if full else 200) for problem in (once, twice)]
    apart = difference(*(positions(trajectory) for trajectory in runs))
    return Outcome(
        f"positions with and without differ by {apart:.1e}; {status(runs[1])}",
        runs[1].success and apart < 1e-10,
        {"apart": apart, "constraint": constraints(runs[1])[0]},
    )

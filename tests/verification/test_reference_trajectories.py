"""Every stored trajectory of an independent dense code is reproduced, with every method."""

import json

import numpy as np
import pytest

from benchmarks.gail2014.dense import named
from tests.support import DATA, PROBLEMS, relative_difference
from vmri_jax import Save, explicit_slow, fully_explicit, fully_implicit, initial_state, simulate

CASES = {case["name"]: case for case in json.loads((DATA / "reference" / "manifest.json").read_text())}


def scheme_of(case):
    if case["scheme"] == "fully_implicit":
        return fully_implicit(case["micro_steps"])
    return {"explicit_slow": explicit_slow, "fully_explicit": fully_explicit}[case["scheme"]](
        case["micro_steps"], case["alpha"]
    )


RUNS = [(name, method) for name in sorted(CASES) for method in ("auto", "dense", "masses", "exact")]
SAM = "sam_explicit_slow_a05_p4"
OFTEN = ("fpu_fully_explicit_a025_p5", "tsp_fully_implicit_a05_p5", "tsp_explicit_slow_a10_p5", SAM)
"""Cases that are solved without --full, with the method of choice: each system and each scheme.

`tests/textbook` has all other pairs on systems of its own; it and `tests/steppers/test_march.py` have the dense method.
"""


@pytest.mark.parametrize(
    ("name", "method"),
    [pytest.param(*run, marks=() if run[0] in OFTEN and run[1] == "auto" else pytest.mark.full) for run in RUNS],
)
def test_trajectory_equals_the_reference(name, method):
    case = CASES[name]
    system = PROBLEMS[case["system"]]().system
    with np.load(DATA / "reference" / f"{name}.npz") as file:
        expected = dict(file)
    state = initial_state(system, *(expected[k] for k in ("q_s0", "q_f0", "v_s0", "v_f0")), project=True)
    run = simulate(
        system,
        scheme_of(case),
        state,
        macro_dt=case["macro_step"],
        num_steps=case["steps"],
        save=Save(micro=True),
        solver=named(method),
    )
    differences = {k: relative_difference(getattr(run, k), expected[k]) for k in ("q_s", "q_f", "p_s", "p_f")}
    # stored micro nodes of a step include its start, ours do not
    differences["q_f_micro"] = relative_difference(run.q_f_micro, expected["q_f_micro"][:, 1:])
    assert max(differences.values()) < 4e-11  # measured 4.4e-12 (fast momenta of SAM), 1e-9 wanted

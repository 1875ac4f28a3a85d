"""Cases 27 and 28: single precision, one bad lane in a batch."""

import vmri_jax as vm
from benchmarks.hard_cases.case import hard_case
from vmri_jax.hard_cases import Outcome
from vmri_jax.hard_cases.measures import bad_lane, single_precision


@hard_case(27, "float32")
def float32(full: bool) -> Outcome:
    """64-bit mode off, and float32 data

    refused with the one-line fix
    """
    return single_precision(vm.systems.fermi_pasta_ulam())


@hard_case(28, "one bad lane in a batch")
def one_bad_lane(full: bool) -> Outcome:
    """256 starts of the FPU chain, one of them absurd

    the bad lane reports its failure, the others equal their single runs to 1e-12
    """
    problem = vm.systems.fermi_pasta_ulam()
    solver = vm.Solver() if full else vm.Solver("masses")  # by default a lane that fails is tried again, exactly
    return bad_lane(problem, vm.fully_implicit(5), 0.01, 100, solver, compared=256 if full else 4)

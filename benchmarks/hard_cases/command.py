"""`python -m benchmarks hard`: the 22 hard cases of this project."""

from benchmarks.measure import prepare
from vmri_jax.cli.check import Full, Numbers, Out, run_and_show


def hard(case: Numbers = None, full: Full = False, out: Out = None) -> None:
    """Hard cases: resonances, large and tiny steps, constraints under stress, contact, long runs.

    Ends with code 1 if a criterion is not met.
    """
    prepare()
    from benchmarks.hard_cases import catalogue  # only now: some cases hold arrays, which start JAX

    run_and_show(catalogue(), case or (), full, out)

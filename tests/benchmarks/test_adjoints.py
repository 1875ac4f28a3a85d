"""The benchmark of gradients, of a small system."""

import pytest

import vmri_jax as vm
from benchmarks import adjoints


@pytest.mark.full
def test_gradients_are_measured():
    case = adjoints.Case("chain", lambda: vm.systems.fermi_pasta_ulam(1), 0.01)
    (report,) = adjoints.run(adjoints.Size((case,), 1), "quick")
    short, long = report.rows
    assert (short["steps"], long["steps"]) == (adjoints.SHORT, adjoints.LONG)
    assert short["over a run"] > 1
    assert len(report.claims) == 2

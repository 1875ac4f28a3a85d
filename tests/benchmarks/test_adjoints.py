"""The benchmark of gradients: a small system through all adjoints."""

import pytest

import vmri_jax as vm
from benchmarks import adjoints


@pytest.mark.full
def test_gradients_are_measured_and_agree():
    case = adjoints.Case("chain", lambda: vm.systems.fermi_pasta_ulam(1), 0.01)
    (report,) = adjoints.run(adjoints.Size((case,), 1), "quick")
    short = {row["gradient"]: row for row in report.rows if row["steps"] == adjoints.SHORT}
    assert set(adjoints.ADJOINTS) <= set(short)
    assert all(short[name]["apart"] < adjoints.AGREEMENT for name in adjoints.ADJOINTS)
    assert all(row["over a run"] > 1 for row in short.values())
    assert len(report.claims) == 5

"""Rows of the benchmark of errors."""

import vmri_jax as vm
from benchmarks import errors


def test_an_estimate():
    case = errors.Case("FPU l=3", 1.0, "fully explicit", vm.fully_explicit(10), 50)
    (report,) = errors.run([case], "quick")
    (row,) = report.rows
    assert set(row) <= set(errors.COLUMNS)
    assert 0.9 < row["estimate / true"] < 1.1  # measured 1.0
    assert 0.9 < row["fast share"] / row["fast limit"] < 1.1
    assert report.notes[0].startswith("1 of 1 estimates")


def test_sizes():
    quick, full = errors.sizes("quick"), errors.sizes("full")
    assert {case.system for case in quick} < {case.system for case in full}
    assert all(case.num_steps % errors.NODES == 0 for case in full)

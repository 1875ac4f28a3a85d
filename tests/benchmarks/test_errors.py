"""Rows of the benchmark of errors: an estimate and a run of an accuracy."""

import vmri_jax as vm
from benchmarks import errors


def test_an_estimate_and_an_accuracy():
    cases = [
        errors.Case("FPU l=3", 1.0, "fully explicit", vm.fully_explicit(10), 50),
        errors.Case("FPU l=3", 1.0, accuracy=1e-2),
    ]
    *_, report = errors.run(cases, "quick")
    estimate, accuracy = report.rows
    assert set(estimate) | set(accuracy) <= set(errors.COLUMNS)
    assert 0.9 < estimate["estimate / true"] < 1.1  # measured 1.0
    assert 0.9 < estimate["fast share"] / estimate["fast limit"] < 1.1
    assert accuracy["true"] <= accuracy["asked"]
    assert report.notes[0].startswith("1 of 1 estimates")


def test_sizes():
    quick, full = errors.sizes("quick"), errors.sizes("full")
    assert {case.system for case in quick} < {case.system for case in full}
    assert all(case.num_steps % errors.NODES == 0 for case in full)

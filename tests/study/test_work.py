"""Work and precision against a reference."""

import pytest

import vmri_jax as vm
from tests.study.test_convergence import PROBLEM
from vmri_jax.study import reference_solution, work_precision


@pytest.fixture(scope="module")
def reference():
    return reference_solution(PROBLEM, 1.0, num_saves=1)


def test_a_reference_refines_itself_until_it_agrees(reference):
    assert 0 < reference.error_q < 1e-12
    assert reference.num_saves == 1


def test_work_precision_counts_and_times(reference, tmp_path):
    schemes = {"impulse": vm.fully_explicit(4), "midpoint": vm.fully_implicit(4)}
    study = work_precision(PROBLEM, schemes, 1.0, num_steps=(50, 100), reference=reference, repeats=2)
    impulse, midpoint = study.curve("impulse"), study.curve("midpoint")
    assert (impulse[0].slow_evaluations, impulse[0].fast_evaluations, impulse[0].solves) == (50, 200, 0)
    assert midpoint[1].solves == 100
    assert midpoint[1].fast_evaluations >= 400
    assert all(0 < row.low <= row.seconds <= row.high for row in study.rows)
    assert impulse[0].error_q / impulse[1].error_q == pytest.approx(4, rel=0.2)
    study.to_csv(tmp_path / "study.csv")
    assert len((tmp_path / "study.csv").read_text().splitlines()) == 5
    labels = {work: study.plot(work=work).axes[0].get_xlabel() for work in ("seconds", "solves")}
    assert labels == {"seconds": "computing time of the run", "solves": "systems of equations solved"}
    with pytest.raises(ValueError, match="schemes is empty"):
        work_precision(PROBLEM, {}, 1.0)
    with pytest.raises(ValueError, match="num_saves = 10"):
        work_precision(PROBLEM, schemes, 1.0, num_steps=(55,), num_saves=10)


def test_ladders_end_by_themselves(reference):
    study = work_precision(PROBLEM, {"high order": vm.galerkin(2, 4)}, 1.0, reference=reference, repeats=1)
    errors = [row.error_q for row in study.curve("high order")]
    assert errors[0] > 1e3 * errors[-1]
    assert len(errors) < 12

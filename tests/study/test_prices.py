"""Prices of functions, the bound of the page of cost, and further potentials in the tables."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.small_systems import no_constraint
from vmri_jax.study import ReferenceSolution, Row, WorkPrecision, convergence_study
from vmri_jax.study.tuning import bound_of, prices

EXACT = ReferenceSolution(np.zeros((2, 4)), np.zeros((2, 4)))
ROW = Row("kicks", 5, 2, 4, 0.1, 1e-3, seconds=2.0, slow_evaluations=4, fast_evaluations=20)


def test_bound_is_the_time_of_the_gradients():
    assert bound_of({"V": 0.1, "W": 0.01}, [ROW]) == ((pytest.approx(4 * 0.1 + 20 * 0.01), 1e-3),)
    assert bound_of({"V": 9.0, "W": 1.0}, [ROW]) == ((2.0, 1e-3),)  # of the run, where a loop of its own is slower


def quartic(q_s, q_f, params):
    return jnp.sum(q_f**4)


def test_tables_list_further_potentials(tmp_path):
    problem = no_constraint()
    problem = replace(problem, system=problem.system.replace(potentials={"bends": quartic, 4: quartic}))
    kicks = vm.quadrature.trapezoidal
    stage = vm.fully_explicit(8).with_potentials(bends=vm.micro(kicks, every=2))
    schemes = {"kicks": stage, "composed": vm.compose(stage, "suzuki4")}
    study = convergence_study(problem, schemes, [0.1], 1.0, num_saves=1, reference=EXACT).work()
    one, five = study.rows
    passes = one.fast_evaluations / (10 * 8)
    assert one.evaluations == {"bends": passes * 10 * 4, 4: passes * 10 * 2}
    assert five.stages == 5
    assert "bends" in str(study)
    assert "V_4" in str(study)
    study.to_csv(tmp_path / "runs.csv")
    assert "evaluations of bends" in (tmp_path / "runs.csv").read_text()
    price = prices(problem)
    assert set(price) == {"V", "W", "bends", 4}
    ((seconds, _),) = bound_of(price, [replace(one, seconds=np.inf)])
    assert seconds > one.evaluations["bends"] * price["bends"] > 0


def test_tables_without_further_potentials_have_no_column_for_them():
    study = WorkPrecision((ROW,), EXACT)
    assert "further gradients" not in str(study)

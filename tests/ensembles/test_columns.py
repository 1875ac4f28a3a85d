"""Rows of a design as problems: by a function of the user."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.ensembles import own
from tests.ensembles.test_ensemble import chain, few
from vmri_jax.ensembles import Table


def test_a_function_of_rows_makes_the_problems(tmp_path):
    design = Table({"speed": [0.5, 2.0, 1.0], "frequency": [20.0, 50.0, 30.0], "num_micro": [3, 3, 4]})
    runs = few(tmp_path / "runs.zarr", system=chain(50.0), design=design, num_micro=None, vary=own.faster)
    data = runs.open()
    assert data.speed.values.tolist() == [0.5, 2.0, 1.0]
    problem = chain(20.0)
    run = vm.simulate(replace(problem, v_s=0.5 * problem.v_s), vm.fully_explicit(3), macro_dt=0.02, num_steps=10)
    assert np.allclose(data.q_f[0], run.q_f[-1], rtol=0, atol=1e-14)


def test_a_function_of_rows_with_dictionaries(tmp_path):
    vary = lambda problem, row: replace(problem, q_f={"hook": problem.q_f[:2], "load": jnp.stack([row["x"], -1.2])})  # noqa: E731
    arguments = {"macro_dt": 0.02, "num_steps": 10}
    runs = vm.ensemble(
        own.hung, vm.fully_explicit(3), {"x": [0.7, 1.0]}, vary=vary, out=tmp_path / "r.zarr", **arguments
    )
    run = vm.simulate(own.hung, vm.fully_explicit(3), **arguments)
    assert np.allclose(runs.open().q_f.sel(x=1.0), run.states.q_f[-1], rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("vary", "error", "message"),
    [
        (lambda problem, row: row, TypeError, r"vary\(problem, row\) is dict; give dataclasses\.replace"),
        (
            lambda problem, row: replace(
                problem, system=problem.system.replace(params=problem.system.params | {"more": 1.0})
            ),
            ValueError,
            "the structure or shape of one of them",
        ),
        (
            lambda problem, row: replace(
                problem, system=problem.system.replace(kinetic=vm.ConstantMass(np.full(3, 2.0), np.full(3, 2.0)))
            ),
            ValueError,
            "the system besides its params",
        ),
    ],
)
def test_functions_of_rows_that_are_refused(tmp_path, vary, error, message):
    with pytest.raises(error, match=message):
        few(tmp_path / "runs.zarr", system=chain(50.0), design={"speed": [1.0]}, vary=vary)
    assert not any(tmp_path.iterdir())


def test_another_function_of_rows_does_not_go_on_with_a_store(tmp_path):
    design = {"speed": [1.0], "frequency": [20.0]}
    out = few(tmp_path / "runs.zarr", system=chain(50.0), design=design, vary=own.faster).path
    slower = lambda problem, row: own.faster(problem, row | {"speed": row["speed"] / 2})  # noqa: E731
    with pytest.raises(ValueError, match="operations of vary"):
        few(out, system=chain(50.0), design=design, vary=slower, resume=True)

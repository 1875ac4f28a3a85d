"""The rank test: rows that depend on each other, outside and inside of compiled programs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from vmri_jax.mechanics.constraints import is_rank_deficient, rank_of

rank_deficient = jax.jit(is_rank_deficient)


@pytest.mark.parametrize(
    ("rows", "rank", "dependent"),
    [
        (np.zeros((0, 3)), 0, []),
        (np.eye(3)[:2], 2, []),
        ([[1.0, 0.0, 0.0], [0.0, 1e-12, 0.0]], 2, []),  # rows count as of length one
        ([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [2.0, 0.0, 0.0]], 2, [0, 2]),
        ([[0.0, 0.0], [1.0, 1.0]], 1, [0]),
        ([[1.0], [2.0]], 1, [0, 1]),
        ([[1.0, 0.0], [1.0, 1e-9]], 1, [0, 1]),
        ([[1.0, 0.0], [1.0, 1e-6]], 2, []),
    ],
)
def test_rank(rows, rank, dependent):
    rows = np.array(rows)
    assert rank_of(rows) == (rank, dependent)
    assert bool(rank_deficient(rows)) is bool(dependent)


def test_rows_are_scaled_with_other_columns():
    rows = np.array([[1e-10, 0.0], [0.0, 1.0]])
    assert not rank_deficient(rows)
    assert rank_deficient(rows, np.array([[1.0], [0.0]]))
    assert not rank_deficient(rows * np.nan)


@pytest.mark.parametrize("moves", [False, True])
def test_refused_rows_have_the_names_that_the_constraint_gives_them(moves):
    def distance(q_s, q_f, params):
        return {"rope": q_s["a"] - q_f["c"][:1], "rail": q_s["a"] - q_s["b"]}

    constraint = vm.Rheonomic(lambda t, *arguments: distance(*arguments)) if moves else distance
    system = vm.System(vm.ConstantMass(slow={"a": 1.0, "b": 1.0}, fast={"c": 1.0}), constraint=constraint)
    problem = vm.Problem(system, q_s={"a": np.zeros(1), "b": np.zeros(1)}, q_f={"c": np.zeros(2)})
    with pytest.raises(ValueError, match=r"row\(s\) 1 \(rail\) of constraint do not depend on the fast variables"):
        vm.simulate(problem, vm.fully_implicit(2), macro_dt=0.1, num_steps=2)


@pytest.mark.parametrize("x", [[0.6, -0.8], [0.6, -0.8 - 1e-9]])
def test_a_square_has_no_gradient_where_it_is_zero(x):
    """Also where the start is as exact as its digits."""

    def squared(q_s, q_f, params):
        return {"rod": (jnp.linalg.norm(q_f["x"]) - 1.0) ** 2}

    system = vm.System(vm.ConstantMass(slow={}, fast={"x": 1.0}), constraint=squared)
    with pytest.raises(ValueError, match=r"gradient of row\(s\) 0 \(rod\) of constraint vanishes .* take its root"):
        vm.Problem(system, q_s={}, q_f={"x": x}).state()

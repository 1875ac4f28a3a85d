"""The rank test: rows that depend on each other, outside and inside of compiled programs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vmri_jax.mechanics.constraints import is_rank_deficient, rank_of


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
    assert bool(jax.jit(is_rank_deficient)(jnp.asarray(rows))) is bool(dependent)


def test_rows_are_scaled_with_other_columns():
    rows = jnp.array([[1e-10, 0.0], [0.0, 1.0]])
    assert not is_rank_deficient(rows)
    assert is_rank_deficient(rows, jnp.array([[1.0], [0.0]]))
    assert not is_rank_deficient(rows * jnp.nan)

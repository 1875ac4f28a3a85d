"""Small dense algebra against LAPACK, and its derivative."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vmri_jax.kernels import cpu as algebra
from vmri_jax.kernels import plain
from vmri_jax.kernels.band import Band, Full, sparsity


def definite(n: int):
    a = np.random.default_rng(n).normal(size=(n, n))
    return a @ a.T + n * np.eye(n) + 0.1 * a  # close to symmetric definite


@pytest.mark.parametrize("n", [1, 2, 5, 12, 20, 50])
def test_solve_and_inverse(n):
    a, b = definite(n), np.random.default_rng(0).normal(size=(n, 3))
    several = np.stack([a, 2 * a.T])
    solved, inverted = jax.jit(lambda a, b, c: (algebra.solve(a, b), algebra.inverse(c)))(a, b, several)
    assert np.abs(a @ np.asarray(solved) - b).max() < 1e-13  # measured 5e-15
    assert np.abs(np.asarray(inverted) @ several - np.eye(n)).max() < 1e-13


@pytest.mark.parametrize(
    ("values", "expected"),
    [([], 0.0), ([-0.0], 0.0), ([1.0, -3.5, 2.0], 3.5), ([1.0, -np.inf], np.inf), ([np.inf, np.nan, 1.0], np.nan)],
)
def test_max_abs(values, expected):
    x = np.array(values)
    found = jax.jit(lambda x: [(m.max_abs(x), jax.vmap(m.max_abs)(jnp.stack([x, x]))[1]) for m in (algebra, plain)])(x)
    if np.isfinite(expected):
        assert np.array_equal(found, [[expected] * 2] * 2)
    else:
        assert not np.any(np.isfinite(found))


def test_max_abs_keeps_a_nan_among_many():
    values = np.ones((300, 300))
    values[7, 200] = np.nan
    assert not np.isfinite(jax.jit(algebra.max_abs)(values))
    assert not np.isfinite(jax.jit(plain.max_abs)(values))


@pytest.mark.parametrize("n", [3])
def test_solve_is_differentiable_in_reverse(n):
    a, b = definite(n), np.ones((n, 1))
    ours = jax.jit(jax.grad(lambda a: jnp.sum(algebra.solve(a, b) ** 2)))(a)
    expected = jax.jit(jax.grad(lambda a: jnp.sum(jnp.linalg.solve(a, b) ** 2)))(a)
    assert np.abs(ours - expected).max() < 1e-13


@pytest.mark.parametrize("n", [2, 30])
def test_products(n):
    a, x = definite(n), np.arange(1.0, n + 1)
    by_vector, by_matrix = jax.jit(lambda a, x: (algebra.matvec(a, x), algebra.matmul(a, a)))(a, x)
    assert by_vector == pytest.approx(a @ x, rel=1e-13)
    assert by_matrix == pytest.approx(a @ a, rel=1e-12, abs=1e-11)


def test_no_library_call_below_the_limit():
    compiled = (
        jax.jit(lambda a, b: algebra.solve(a, b) + algebra.matmul(a, b)).lower(np.eye(12), np.ones((12, 2))).compile()
    )
    assert "custom-call" not in str(compiled.as_text())


@pytest.mark.parametrize(("n", "width", "nodes"), [(30, 2, 1), (41, 3, 1), (30, 2, 2), (9, 8, 1)])
def test_a_band_in_any_order_is_inverted_like_the_full_matrix(n, width, nodes):
    rng = np.random.default_rng(n)
    near = np.abs(np.subtract.outer(np.arange(n), np.arange(n))) <= width
    shuffled = rng.permutation(n)
    pattern = near[np.ix_(shuffled, shuffled)]
    blocks = np.tile(pattern, (nodes, nodes))
    a = np.where(blocks, 0.1 * rng.normal(size=blocks.shape), 0.0) + np.diag(1 + rng.random(n * nodes))
    g = rng.normal(size=n * nodes)

    structure = sparsity(pattern, nodes)
    assert isinstance(structure, Full if width == 8 else Band)

    @jax.jit
    def both(g):
        products = structure.seeds @ a.T
        return structure.inverse(products).times(g), structure.solve(products, g)

    assert np.abs(np.stack(both(g)) - np.linalg.solve(a, g)).max() < 1e-13

"""What is read off jaxprs: dependence, constant Hessians, diagonal Hessians."""

import jax
import jax.numpy as jnp
import pytest

from vmri_jax.structure import has_constant_hessian, has_diagonal_hessian

Q = jnp.linspace(0.5, 1.5, 4)


def nested(q):
    return jax.jit(lambda q: jnp.sum(jnp.where(q > 0, q, q**3) * jnp.cos(q)))(q)


@pytest.mark.parametrize(
    ("function", "diagonal", "constant"),
    [
        (lambda q: jnp.sum(q**2), True, True),
        (lambda q: 3.0 * jnp.sum(jnp.arange(4.0) * q**2 + q), True, True),
        (lambda q: jnp.sum(q**4) / 4, True, False),
        (nested, True, False),
        (lambda q: jnp.sum(q) ** 2, False, True),
        (lambda q: q[0] * q[1], False, True),
        (lambda q: jnp.sum((q[1:] - q[:-1]) ** 2), False, True),
        (lambda q: jnp.linalg.norm(q), False, False),
        (lambda q: jnp.sum(q**2 * q[0]), False, False),
    ],
)
def test_hessians(function, diagonal, constant):
    assert has_diagonal_hessian(function, Q) is diagonal
    assert has_constant_hessian(function, Q) is constant
    hessian = jax.hessian(function)(Q)
    if diagonal:
        assert bool(jnp.all(hessian == jnp.diag(jnp.diag(hessian))))
    if constant:
        assert bool(jnp.allclose(hessian, jax.hessian(function)(2 * Q)))


def test_constant_hessian_of_several_arguments():
    assert has_constant_hessian(lambda a, b: jnp.sum(a * b), Q, Q)
    assert not has_constant_hessian(lambda a, b: jnp.sum(a * b**2), Q, Q)

"""What is read off jaxprs: dependence, constant Hessians, diagonal Hessians."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vmri_jax.structure import has_constant_hessian, has_curvature, has_diagonal_hessian

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


@pytest.mark.parametrize(
    ("function", "curved"),
    [
        (lambda q: jnp.sum(jnp.arange(4.0) * q), [False] * 4),
        (lambda q: jnp.sum(jnp.arange(4.0) * q**2), [True] * 4),
        (lambda q: jnp.sum((q[1:3] - q[:2]) ** 2) + q[3], [True, True, True, False]),
        (lambda q: jnp.linalg.norm(q[::2]) + nested(q[3:]), [True, False, True, True]),
        (lambda q: jnp.prod(q.reshape(2, 2).T[1]) - 9.81 * q[2], [False, True, False, True]),
        (lambda q: jnp.sum(jnp.concatenate([q[2:], q[:1]]) ** 2), [True, False, True, True]),
        (lambda q: jnp.sum(jnp.broadcast_to(q[:1], (3,)) * jnp.stack([q[0], q[0], q[3]])), [True, False, False, True]),
        (lambda q: jnp.sum(jnp.flip(q)[:2] ** 3), [False, False, True, True]),
    ],
)
def test_curvature(function, curved):
    """What has a curvature is found; what is said to have none has none."""
    found = has_curvature(function, Q)
    bent = np.any(np.asarray(jax.hessian(function)(Q)) != 0, axis=0)
    assert not np.any(bent & ~found)
    assert found.tolist() == curved


def test_unknown_operations_bend_everything():
    assert has_curvature(lambda q: jnp.sum(jnp.sort(q)[:2] ** 2), Q).all()

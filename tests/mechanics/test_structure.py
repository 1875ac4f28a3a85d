"""What is read off jaxprs: dependence, constant Hessians, diagonal Hessians."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import Primitive

from vmri_jax.mechanics.rows import Entries
from vmri_jax.mechanics.structure import (
    curved_directions,
    depends_on,
    entries_seen,
    has_constant_hessian,
    has_diagonal_hessian,
)

Q = np.linspace(0.5, 1.5, 4)


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
        (lambda q: jnp.sum(jnp.diff(q) ** 2 + jnp.roll(q, 1)[1:] * q[:-1]), False, True),
        (lambda q: jnp.linalg.norm(q), False, False),
        (lambda q: jnp.sum(q**2 * q[0]), False, False),
        (lambda q: jnp.sum(q[::-1] * q), False, True),
        (lambda q: jnp.sum(jnp.cumsum(q) ** 2), False, True),
        (lambda q: jnp.sum((jnp.eye(4)[::-1] @ q) * q), False, True),
        (lambda q: jnp.sum(jnp.maximum(q, 0.0) ** 2), True, False),
    ],
)
def test_hessians(function, diagonal, constant):
    assert has_diagonal_hessian(function, Q) is diagonal
    assert has_constant_hessian(function, Q) is constant
    of = jax.jit(jax.hessian(function))
    hessian = np.asarray(of(Q))
    if diagonal:
        assert np.all(hessian == np.diag(np.diag(hessian)))
    if constant:
        assert np.allclose(hessian, of(2 * Q))


def test_constant_hessian_of_several_arguments():
    assert has_constant_hessian(lambda a, b: jnp.sum(a * b), Q, Q)
    assert not has_constant_hessian(lambda a, b: jnp.sum(a * b**2), Q, Q)


@jax.jit
def weighed(q):
    """A distance and a weight, which has no curvature."""
    return jnp.linalg.norm(q[2:] - q[:2]) + 9.81 * jnp.sum(jnp.arange(4.0) * q)


@pytest.mark.parametrize(
    ("function", "rank", "curved"),
    [
        (lambda q: jnp.sum(jnp.arange(4.0) * q), 0, [False] * 4),
        (lambda q: jnp.sum(jnp.arange(4.0) * q**2), 4, [True] * 4),
        (lambda q: jnp.sum((q[1:3] - q[:2]) ** 2) + q[3], 2, [True, True, True, False]),
        (lambda q: jnp.linalg.norm(q[::2]) + nested(q[3:]), 3, [True, False, True, True]),
        (lambda q: jnp.prod(q.reshape(2, 2).T[1]) - 9.81 * q[2], 2, [False, True, False, True]),
        (lambda q: jnp.sum(jnp.concatenate([q[2:], q[:1]]) ** 2), 3, [True, False, True, True]),
        (
            lambda q: jnp.sum(jnp.broadcast_to(q[:1], (3,)) * jnp.stack([q[0], q[0], q[3]])),
            2,
            [True, False, False, True],
        ),
        (lambda q: jnp.sum(jnp.flip(q)[:2] ** 3), 2, [False, False, True, True]),
        (lambda q: jnp.sum((jnp.roll(q, 1) - q) ** 4), 3, [True] * 4),
        (lambda q: jnp.cosh(jnp.sum(q[:3])) * nested(q[3:]), 2, [True] * 4),
        (lambda q: jnp.sum(jax.lax.pad(jnp.diff(q), 0.0, [(-2, 2, 1)]) ** 3), 2, [False, True, True, True]),
        (lambda q: jax.lax.fori_loop(0, 3, lambda _, x: x * (q[1] - q[0]), 1.0), 1, [True, True, False, False]),
        (weighed, 2, [True] * 4),
    ],
)
def test_curved_directions(function, rank, curved):
    """They are as few as can be, and the Hessian has nothing beside them."""
    directions = curved_directions(function, Q)
    assert directions.shape == (rank, 4)
    assert directions.any(axis=0).tolist() == curved
    beside = np.eye(4) - np.linalg.pinv(directions) @ directions
    hessian = np.asarray(jax.jit(jax.hessian(function))(Q**2))
    assert np.abs(hessian @ beside).max() <= 1e-14 * np.abs(hessian).max()


def test_unknown_operations_bend_everything():
    assert curved_directions(lambda q: jnp.sum(jnp.sort(q)[:2] ** 2), Q).shape == (4, 4)


def loops(a, b, n, flag):
    """What each of the results depends on is in its name."""
    a_n = jax.lax.fori_loop(0, n, lambda _, x: 2 * x, a)
    both, only_b = jax.lax.fori_loop(0, 3, lambda _, at: (at[0] + at[1], 2 * at[1]), (a, b))
    (last_of_a,), b_too = jax.lax.scan(lambda at, x: ((at[0] + 1,), at[0] * x), (a,), b * jnp.ones(3))
    flag_b, flag_too = jax.lax.cond(flag, lambda b: (b, 1.0), lambda b: (-b, 2.0), b)
    return a_n, both, only_b, last_of_a, b_too, flag_b, flag_too


@pytest.mark.parametrize(
    ("changed", "reaches"),
    [
        (0, [True, True, False, True, True, False, False]),
        (1, [False, True, True, False, True, True, False]),
        (2, [True, False, False, False, False, False, False]),
        (3, [False, False, False, False, False, True, True]),
    ],
)
def test_what_an_argument_reaches_through_loops(changed, reaches):
    depends = [depends_on(lambda *args, k=k: jax.jit(loops)(*args)[k], 1.0, 2.0, 3, True) for k in range(7)]
    assert [of_result[changed] for of_result in depends] == reaches


NEW = Primitive("operation_of_a_later_version")
NEW.def_abstract_eval(lambda x: x)


@jax.custom_jvp
def new(x):
    return NEW.bind(x)


@new.defjvp
def _(primals, tangents):
    return new(*primals), new(*primals) * tangents[0]


def printing(q):
    jax.debug.print("{}", q[0])
    return jnp.sum(q**2)


@pytest.mark.parametrize("function", [lambda q: jnp.sum(new(q)), printing])
def test_what_is_not_known_gets_the_safe_answer(function):
    """Operations that a later version may bring, and effects.

    The derivative of the new operation acts entry by entry.
    """
    assert has_diagonal_hessian(function, Q) == (function is not printing)
    assert not has_constant_hessian(function, Q)
    assert np.linalg.matrix_rank(curved_directions(function, Q)) == 4
    assert depends_on(lambda q, other: function(q), Q, Q)[0]


@pytest.mark.parametrize(
    ("function", "seen"),
    [
        (lambda q: jnp.sum(jnp.concatenate([q[2:], q])[:2] ** 2), [0, 0, 1, 1]),
        (lambda q: jax.jvp(lambda q: jnp.cos(q[1:3]), (q,), (q,))[1], [0, 1, 1, 0]),
        (lambda q: jax.lax.scan(lambda c, x: (c * x, c), jnp.pad(q[:1], (0, 1)), jnp.ones(3))[0], [1, 0, 0, 0]),
        (lambda q: 3.0 * q[3], [0, 0, 0, 1]),
        (lambda q: jnp.linalg.norm(q), [1, 1, 1, 1]),
        (lambda q: jnp.ones(2), [0, 0, 0, 0]),
    ],
)
def test_entries_that_are_seen(function, seen):
    assert entries_seen(function, Q).tolist() == [bool(s) for s in seen]
    assert entries_seen(lambda q: jnp.sum(q**2), jnp.zeros(0)).size == 0


def test_entries_are_taken_and_put_back():
    entries = Entries((False, True, True, False, True))
    rows = jnp.arange(10.0).reshape(2, 5)
    assert (entries.count, entries.ends) == (3, [1, 3, 4, 5])
    assert entries.take(rows).tolist() == [[1, 2, 4], [6, 7, 9]]
    assert entries.put(-entries.take(rows), rows).tolist() == [[0, -1, -2, 3, -4], [5, -6, -7, 8, -9]]
    none = Entries((False, False))
    assert none.put(none.take(jnp.ones(2)), jnp.ones(2)).tolist() == [1, 1]

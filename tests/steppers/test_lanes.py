"""`over_lanes` does what ``jax.vmap`` does, with the batch axis last."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vmri_jax.steppers import lanes
from vmri_jax.steppers.lanes import over_lanes

LANES = 5


def derivative_of_slices(x, k):
    return jax.grad(lambda x: jnp.sum(x[1:] * x[:-1] ** 2) + x[2] ** 3 + jnp.sum(jnp.stack([x[0], x[3]]) ** 4))(x)


def products(x, k):
    a = jnp.outer(x, x) + np.eye(4)
    return a @ x, x @ np.arange(12.0).reshape(4, 3), np.ones((2, 4)) @ a, jnp.einsum("ij,jk,k->i", a, a, x)


def library_calls(x, k):
    return jnp.linalg.solve(jnp.outer(x, x) + 5 * jnp.eye(4), x), jnp.sort(x)


def lane_dependent_loop(x, k):
    return jax.lax.while_loop(lambda c: c[1] < k, lambda c: (c[0] * 1.5, c[1] + 1, c[2]), (x, 0, jnp.ones(2)))


def loops_side_by_side(x, k):
    def count(limit, x):
        return jax.lax.while_loop(lambda c: c[1] < limit, lambda c: (c[0] * 1.5, c[1] + 1), (jnp.stack([x, x]), 0))

    return jax.vmap(count)(k * jnp.arange(4), x), jax.vmap(count)(jnp.arange(4), x)


def shared_loop(x, k):
    return jax.lax.fori_loop(0, 3, lambda i, c: (c[0] + i * c[1], c[1]), (x, jnp.ones(4)))


def scanned(x, k):
    def step(carry, at):
        return (carry[0] * at[0] + carry[1], carry[1] + 1), (carry[0].sum(), at[1])

    return jax.lax.scan(step, (x, 0.0), (x, jnp.arange(4)), reverse=True)


def branches(x, k):
    lane = jax.lax.cond(k > 2, lambda x: 2 * x, lambda x: x - 1, x)
    shared = jax.lax.cond(jnp.asarray(1) > 0, lambda x: (x, jnp.zeros(2)), lambda x: (-x, jnp.ones(2)), x)
    return lane, shared, jax.lax.switch(k, [jnp.sin, jnp.cos, lambda x: x], x)


def indices(x, k):
    same, other = jax.lax.dynamic_slice(x, (jnp.asarray(1),), (2,)), jax.lax.dynamic_slice(x, (k,), (2,))
    return same, other, x.at[1].set(3.0), x.at[k].add(1.0), jnp.argmax(x), jnp.cumsum(x)[::-1], x[jnp.array([2, 0])]


def shapes(x, k):
    a = jnp.concatenate([x, np.ones(2)]).reshape(2, 3).T
    return jnp.pad(a, 1, constant_values=2.0), a[None, :, ::-1], jnp.where(k > 1, a, 0.0), jnp.clip(x, -1, k), a.max(0)


def called(x, k):
    return jax.jit(jnp.tanh)(x), jax.checkpoint(jnp.sin)(x), jax.nn.relu(x), jnp.zeros(3)


@pytest.mark.parametrize(
    "function",
    [
        derivative_of_slices,
        products,
        library_calls,
        lane_dependent_loop,
        loops_side_by_side,
        shared_loop,
        scanned,
        branches,
        indices,
        shapes,
        called,
    ],
)
def test_same_as_vmap(function):
    x, k = np.random.default_rng(0).normal(size=(LANES, 4)), np.arange(LANES)
    expected = jax.vmap(function)(x, k)
    found = over_lanes(lambda at: function(*at), LANES)((jnp.asarray(x.T), jnp.asarray(k)))
    for a, b in zip(jax.tree.leaves(expected), jax.tree.leaves(found), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_allclose(np.moveaxis(np.asarray(b), -1, 0), a, rtol=1e-13, atol=1e-14)


def test_sums_of_padded_arrays_have_no_pads():
    text = str(jax.make_jaxpr(over_lanes(lambda x: derivative_of_slices(x, 0), LANES))(jnp.ones((4, LANES))))
    assert " pad[" not in text
    assert "concatenate[" in text


def test_loops_within_loops_are_read_once(monkeypatch):
    def nested(depth):
        if depth == 0:
            return lambda x, shared: (jnp.sin(x), shared)
        inner = nested(depth - 1)
        return lambda x, shared: jax.lax.fori_loop(0, 2, lambda _, at: inner(at[1] * at[0], at[1]), (x, shared))

    def count(depth):
        count.runs = 0
        jax.make_jaxpr(over_lanes(lambda x: nested(depth)(x, 2.0), LANES))(jnp.ones((4, LANES)))
        return count.runs

    def counted(*args, run=lanes._run):
        count.runs += 1
        return run(*args)

    monkeypatch.setattr(lanes, "_run", counted)
    assert count(6) - count(5) == count(3) - count(2)

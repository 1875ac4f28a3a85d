"""Programs that are one kernel: the same results, without what XLA makes anew at every call."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vmri_jax.runtime import SHORT, in_one_kernel


def reductions(jaxpr) -> list[tuple[str, int, int]]:
    """Name, numbers before and numbers after every reduction, also of inner jaxprs."""
    found = []
    for eqn in jaxpr.eqns:
        if eqn.primitive.name.startswith("reduce_"):
            found.append((eqn.primitive.name, eqn.invars[0].aval.size, eqn.outvars[0].aval.size))
        for value in eqn.params.values():
            for inner in value if isinstance(value, tuple) else [value]:
                if hasattr(inner, "eqns") or hasattr(inner, "jaxpr"):
                    found += reductions(getattr(inner, "jaxpr", inner))
    return found


def once(x):
    """Reductions outside of loops: of all entries, over axes, of nothing."""
    rows = x.reshape(2, 3)
    return rows.sum(0), rows.sum(), rows.max(1), jnp.all(x > 0), jnp.any(rows < 1, axis=1), rows[:0].sum(0)


def in_loops(x):
    """Reductions in a scan, a while loop and a branch, and in functions that are called there."""

    def step(x, _):
        return jax.lax.cond(jnp.sum(x) > 1, lambda x: x / jnp.linalg.norm(x), lambda x: x * jnp.max(x), x), x.min()

    x, least = jax.lax.scan(step, x, length=3)
    return jax.lax.while_loop(lambda x: jnp.sum(x) < 5, jax.jit(lambda x: x + jnp.sum(x**2)), x), least


def over_rows(x):
    """A reduction in a loop to more than one number."""
    return jax.lax.fori_loop(0, 3, lambda _, rows: rows * rows.sum(1, keepdims=True), x.reshape(3, 2))


@pytest.mark.parametrize("function", [once, in_loops, over_rows])
@pytest.mark.parametrize("last", [0.5, np.nan, np.inf])
def test_a_program_in_one_kernel_computes_the_same(function, last):
    x = jnp.linspace(0.1, 0.7, 6).at[-1].set(last)
    if function is in_loops:
        x = jnp.where(jnp.isfinite(x), x, 0.9)  # the loop would not end
    for there, here in zip(jax.jit(in_one_kernel(function))(x), function(x), strict=True):
        np.testing.assert_allclose(there, here, rtol=1e-14)


def test_short_reductions_are_written_out():
    x = jnp.ones(6)
    assert reductions(jax.make_jaxpr(in_one_kernel(once))(x).jaxpr) == [("reduce_sum", 0, 3)]
    assert reductions(jax.make_jaxpr(in_one_kernel(in_loops))(x).jaxpr) == []
    assert reductions(jax.make_jaxpr(in_one_kernel(over_rows))(x).jaxpr) == [("reduce_sum", 6, 3)]
    long = jnp.ones(SHORT + 1)
    assert reductions(jax.make_jaxpr(in_one_kernel(jnp.sum))(long).jaxpr) == [("reduce_sum", SHORT + 1, 1)]

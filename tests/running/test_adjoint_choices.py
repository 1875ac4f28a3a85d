"""Adjoints of runs: lanes of gradients, second derivatives, the choice of auto, and names that are refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.running.test_adjoints import simple_cost, simple_gradient
from vmri_jax.running import simulation


def test_lanes_of_gradients():
    steps = "kicks"
    cost, at = simple_cost("checkpoint", steps)
    starts = jnp.stack([at, 1.1 * at])
    lanes = jax.jit(jax.vmap(jax.grad(cost)))(starts)
    np.testing.assert_allclose(lanes[1], simple_gradient("stored", steps)(starts[1]), rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize(("second", "compiled"), [(jax.jacfwd, False), (jax.jacrev, True)])
def test_second_derivatives_are_refused(second, compiled):
    cost, at = simple_cost("checkpoint")
    gradient = jax.grad(cost)
    with pytest.raises(TypeError, match="stored"):
        second(jax.jit(gradient) if compiled else gradient)(at)


def test_stored_steps_have_second_derivatives():
    """Reverse over reverse; `tests/verification/test_gradients.py` takes forward over reverse."""
    gradient, at = simple_gradient("stored"), simple_cost("stored")[1]
    h = 1e-5
    expected = jnp.stack([(gradient(at + h * e) - gradient(at - h * e)) / (2 * h) for e in jnp.eye(at.size)])
    np.testing.assert_allclose(jax.jit(jax.jacrev(gradient))(at), expected, rtol=1e-6, atol=1e-8)


def test_what_auto_chooses(monkeypatch):
    """Values with the derivatives that `checkpoint` refuses tell which adjoint has been taken."""
    cost, at = simple_cost("auto")
    monkeypatch.setattr(simulation, "LONGEST_STORED_RUN", 5)
    np.testing.assert_allclose(jax.jit(jax.grad(cost))(at), simple_gradient("stored")(at), rtol=1e-11, atol=1e-12)
    with pytest.raises(TypeError, match="stored"):
        jax.jacfwd(jax.grad(cost))(at)


@pytest.mark.parametrize("name", ["reversible", "forward"])
def test_adjoints_that_do_not_exist(name):
    with pytest.raises(ValueError, match=f"adjoint is '{name}'; it must be one of 'auto', 'stored', 'checkpoint'"):
        vm.Save(adjoint=name)

"""Adjoints of runs: lanes of gradients, second derivatives, what auto chooses, and what is refused."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.running.test_adjoints import UNSYMMETRIC, simple_cost, simple_gradient
from tests.user_systems import cart
from vmri_jax.running import adjoints


@pytest.mark.parametrize(("adjoint", "steps"), [("checkpoint", "kicks"), ("reversible", "solved")])
def test_lanes_of_gradients(adjoint, steps):
    cost, at = simple_cost(adjoint, steps)
    starts = jnp.stack([at, 1.1 * at])
    lanes = jax.jit(jax.vmap(jax.grad(cost)))(starts)
    np.testing.assert_allclose(lanes[1], simple_gradient("stored", steps)(starts[1]), rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("adjoint", ["checkpoint", "reversible"])
@pytest.mark.parametrize(("second", "compiled"), [(jax.jacfwd, False), (jax.jacrev, True)])
def test_second_derivatives_are_refused(adjoint, second, compiled):
    cost, at = simple_cost(adjoint)
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
    choose = partial(adjoints.chosen_adjoint, "auto")
    assert choose(vm.fully_implicit(2), adjoints.LONGEST_STORED_RUN, False) == "stored"
    assert choose(vm.fully_implicit(2), adjoints.LONGEST_STORED_RUN + 1, False) == "reversible"
    assert choose(vm.fully_implicit(2), adjoints.LONGEST_STORED_RUN + 1, True) == "checkpoint"
    assert choose(UNSYMMETRIC, adjoints.LONGEST_STORED_RUN + 1, False) == "checkpoint"
    monkeypatch.setattr(adjoints, "LONGEST_STORED_RUN", 5)
    with pytest.warns(UserWarning, match="6 steps use adjoint='reversible'"):
        chosen = simple_gradient("auto")(simple_cost("auto")[1])
    np.testing.assert_allclose(chosen, simple_gradient("stored")(simple_cost("stored")[1]), rtol=1e-11, atol=1e-12)
    monkeypatch.setattr(adjoints, "REPORTED_GAP", 0.0)
    with pytest.warns(UserWarning, match="missed the one before by"):
        jax.block_until_ready(simple_gradient("auto")(simple_cost("auto")[1]))


def test_bad_adjoints():
    with pytest.raises(ValueError, match="adjoint is 'revers'; it must be one of 'auto', 'stored'"):
        vm.simulate(cart(), vm.fully_explicit(2), macro_dt=0.1, num_steps=1, adjoint="revers")
    with pytest.raises(ValueError, match="needs a symmetric scheme"):
        vm.simulate(cart(), UNSYMMETRIC, macro_dt=0.1, num_steps=1, adjoint="reversible")


def test_forward_by_many_numbers_is_said(monkeypatch):
    monkeypatch.setattr(adjoints, "MOST_TANGENTS", 0)
    cost, at = simple_cost("forward")
    with pytest.warns(UserWarning, match=f"each of the {at.size} numbers"):
        jax.eval_shape(jax.grad(cost), at)

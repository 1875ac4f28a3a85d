"""Which terms of a system depend explicitly on time, and what happens in them."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pytest

import vmri_jax as vm
from vmri_jax.mechanics.driving import driven


def spring(q_s, q_f, params):
    return jnp.sum(q_s**2) / 2


def damped(t, q_s, q_f, v_s, v_f, params):
    return -v_s, -v_f


def kicked(t, q_s, q_f, v_s, v_f, params):
    return jnp.where(t > 1e9, 1.0, 0.0) - v_s, -v_f


def frozen(t, q_s, q_f, v_s, v_f, params):
    return jax.lax.cond(jax.lax.stop_gradient(t) > 3, lambda q: q, lambda q: -q, q_s), q_f


def on_a_disc(t, q_s, q_f, params):
    return q_f[:1] - jnp.cos(t)


def at_rest(t, q_s, params):
    return q_s[:1]


@pytest.mark.parametrize(
    ("terms", "names"),
    [
        ({}, ()),
        ({"force": damped}, ()),
        ({"force": kicked}, ("force",)),
        ({"force": frozen}, ("force",)),
        ({"slow_constraint": vm.Rheonomic(at_rest)}, ()),
        ({"force": kicked, "constraint": vm.Rheonomic(on_a_disc)}, ("force", "constraint")),
    ],
)
def test_terms_that_depend_on_time(terms, names):
    system = vm.System(vm.ConstantMass(slow=[1.0, 1.0], fast=[1.0]), spring, **terms)
    assert driven(system, SimpleNamespace(q_s=jnp.ones(2), q_f=jnp.ones(1))) == names

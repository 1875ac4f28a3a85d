"""Kinetic energy of slow variables alone: on the macro grid, with the order of the scheme and its symplecticity."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.support import NAMES, area_change, largest_difference, node
from tests.textbook.residual import residual
from vmri_jax import ConstantMass, Problem, Save, System, fully_implicit, galerkin, initial_state, simulate, textbook
from vmri_jax.diagnostics import fit_order


def arm(q_s, v_s, params):
    """Of a slow arm whose inertia changes with its angle."""
    return params["inertia"] / 2 * (1 + 0.4 * jnp.cos(q_s[0])) * v_s[0] ** 2


def steady_arm(q_s, v_s, params):
    """Of an arm with constant inertia."""
    return params["inertia"] / 2 * v_s[0] ** 2


def tip(q_s, q_f, v_s, v_f, params):
    """Of a light fast rod at the end of the arm."""
    return v_s[0] ** 2 / 20 + v_f[0] ** 2 / 4 + v_s[0] * v_f[0] * jnp.cos(q_s[0] - q_f[0]) / 10


def steady_together(q_s, q_f, v_s, v_f, params):
    return steady_arm(q_s, v_s, params) + tip(q_s, q_f, v_s, v_f, params)


def weight(q_s, q_f, params):
    return -9.81 * (2 * jnp.cos(q_s[0]) + jnp.cos(q_f[0]) / 10)


def spring(q_f, params):
    return 40.0 * q_f[0] ** 2


def problem(slow_kinetic=arm, kinetic=tip) -> Problem:
    """The arm and the rod."""
    system = System(kinetic, weight, spring, params={"inertia": 2.0}, slow_kinetic=slow_kinetic)
    return Problem(system, [1.0], [0.2], [0.5], [2.0])


SCHEMES = {"fully implicit": (fully_implicit(4), (40, 80, 160), 2), "gauss 2": (galerkin(4, 2), (20, 40, 80), 4)}


def end_of(problem, scheme, num_steps):
    """The node at time 1."""
    run = simulate(problem, scheme, macro_dt=1 / num_steps, num_steps=num_steps, save=num_steps)
    return [np.asarray(getattr(run, name)[-1]) for name in NAMES]


def test_a_step_of_degree_two_is_that_of_the_textbook():
    scheme, moved = SCHEMES["gauss 2"][0], problem()
    ours = simulate(moved, scheme, macro_dt=0.05, num_steps=1).final_state
    theirs = jax.jit(textbook.step)(moved.system, scheme, moved.state(), 0.05)
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("name", ["gauss 2", pytest.param("fully implicit", marks=pytest.mark.full)])
def test_order(name):
    scheme, steps, order = SCHEMES[name]
    reference = end_of(problem(), SCHEMES["gauss 2"][0], 640)
    errors = [
        [largest_difference(a, b) for a, b in zip(end_of(problem(), scheme, n), reference, strict=True)] for n in steps
    ]
    observed = [fit_order(1 / np.array(steps), e).order for e in np.transpose(errors)]
    assert observed == pytest.approx([order] * 4, abs=0.2)


def test_steps_of_degree_one_are_those_of_the_textbook_and_symplectic():
    moved, scheme = problem(), SCHEMES["fully implicit"][0]

    def run(x):
        at = moved.q_s, moved.q_f, moved.v_s, moved.v_f
        start = initial_state(moved.system, *(a + dx for a, dx in zip(at, np.split(x, 4), strict=True)))
        return simulate(moved.system, scheme, start, macro_dt=0.02, num_steps=20, save=Save(micro=True))

    def ends(x):
        nodes = run(x)
        return node(nodes, 0), node(nodes, 20)

    assert residual(moved.system, scheme, run(np.zeros(4)), 0.02) < 1e-13
    assert area_change(ends, 4) < 1e-11


def test_constant_inertia_may_be_on_either_grid():
    """The path of the arm is linear: all steps have one discrete Lagrangian."""
    scheme, random = SCHEMES["fully implicit"][0], np.random.default_rng(0)
    points = random.normal(size=(2, 1)), random.normal(size=(scheme.num_micro + 1, 1))
    apart, together = (
        jax.jit(textbook.discrete_lagrangian(p.system, scheme))(*points, 0.1)
        for p in (problem(steady_arm), problem(None, steady_together))
    )
    assert float(apart) == pytest.approx(float(together), rel=1e-13)


def test_constant_masses_are_all_masses():
    with pytest.raises(ValueError, match="slow_kinetic is given besides a ConstantMass"):
        System(ConstantMass([1.0], [1.0]), slow_kinetic=arm)
    with pytest.raises(TypeError, match="q_s, v_s, params"):
        problem(tip)

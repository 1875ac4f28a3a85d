"""Motions in joint coordinates: orders of schemes, energy over many steps, gradients and fits of a scene's numbers."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from vmri_jax.scene import Box, Gravity, JointDamper, JointSpring, Revolute, RigidBody, Scene

STATE = {"shoulder": (0.3, 0.5), "elbow": (-0.4, 1.0)}


def arm(length: Any = 1.0, mass: Any = 0.7, stiffness: Any = 3.0, rate: Any = "slow"):
    """Two bars on hinges with oblique axes: the second one's place, mass and spring are numbers, its pace is `rate`."""
    upper = RigidBody("upper", 1.2, Box((1.0, 0.1, 0.2)), [0.5, 0.0, 0.0], pace="slow")
    place = jnp.array([1.0, 0.0, 0.0]) + length * jnp.array([0.4, 0.0, 0.0])
    lower = RigidBody("lower", mass, Box((0.8, 0.1, 0.1)), place, pace=rate)
    effects = [
        Revolute(("ground", "upper"), [0, 0, 0], axis=[0, 1, 0.2], name="shoulder"),
        Revolute(("upper", "lower"), [1, 0, 0], axis=[0, 1, -0.3], name="elbow"),
        JointSpring("elbow", stiffness, 0.2, rate=rate),
        Gravity([0, 0, -9.81]),
    ]
    return Scene([upper, lower], effects, coordinates="joint").with_joints(STATE)


def end(scheme, steps: int, scene=None):
    """Both angles after 0.4 s."""
    run = vm.simulate(scene or arm(), scheme, macro_dt=0.4 / steps, num_steps=steps, save=steps)
    return np.concatenate([run.position("shoulder")[-1], run.position("elbow")[-1]])


@pytest.mark.parametrize(("composition", "order", "steps"), [(None, 2, 20), ("suzuki4", 4, 10), ("kahan-li6", 6, 10)])
def test_orders_of_schemes(composition, order, steps):
    scheme = vm.fully_implicit(1)
    scheme = scheme if composition is None else vm.compose(scheme, composition)
    coarse, middle, fine = (end(scheme, k * steps) for k in (1, 2, 4))
    seen = np.log2(np.linalg.norm(coarse - middle) / np.linalg.norm(middle - fine))
    assert seen == pytest.approx(order, abs=0.3)


def test_micro_steps_have_the_order_of_their_scheme():
    """A fast bar on a slow one: the spring between them is W, and is felt by its angle alone."""
    scheme = vm.fully_implicit(4)
    coarse, middle, fine = (end(scheme, k * 10, arm(stiffness=60.0, rate="fast")) for k in (1, 2, 4))
    assert np.log2(np.linalg.norm(coarse - middle) / np.linalg.norm(middle - fine)) == pytest.approx(2, abs=0.2)


def test_energy_of_a_long_run_does_not_drift():
    """1e5 steps of 0.02 s, chaotic: the error of the energy stays in the band of the first steps."""
    run = vm.simulate(arm(), vm.fully_implicit(1), macro_dt=0.02, num_steps=100_000, save=10)
    error = np.asarray(run.energy - run.energy[0])
    pieces = np.abs(error[1:]).reshape(10, -1).max(axis=1)
    assert pieces[-1] < 1.5 * pieces[0], pieces
    means = error[1:].reshape(10, -1).mean(axis=1)
    assert abs(means[-1] - means[0]) < 0.2 * pieces[0], means


def test_gradients_through_length_mass_and_stiffness():
    scheme = vm.fully_implicit(2)

    @jax.jit
    def reach(numbers):
        scene = arm(*numbers)
        run = vm.simulate(scene.system(), scheme, scene.state(), macro_dt=0.02, num_steps=20, save=20)
        return run.q_s[-1, 0] + 2 * run.q_s[-1, 1]

    numbers = jnp.array([1.0, 0.7, 3.0])
    found = jax.grad(reach)(numbers)
    for i, step in enumerate((1e-4, 1e-4, 1e-3)):
        low, high = (reach(numbers.at[i].add(sign * step)) for sign in (-1, 1))
        assert float(found[i]) == pytest.approx(
            float(high - low) / (2 * step), rel=1e-6, abs=2e-8
        )  # values of 0.001 to 0.2


def swing(numbers):
    """A bar on a hinge with a spring and a damper."""
    bar = RigidBody("bar", 1.2, Box((1.0, 0.1, 0.2)), [0.5, 0.0, 0.0], pace="slow")
    effects = [
        Revolute(("ground", "bar"), [0, 0, 0], axis=[0, 1, 0.2], name="hinge"),
        JointSpring("hinge", numbers["stiffness"], 0.2, rate="slow"),
        JointDamper("hinge", numbers["damping"]),
        Gravity([0, 0, -9.81]),
    ]
    return Scene([bar], effects, coordinates="joint").with_joints({"hinge": (0.3, 0.5)}).problem()


def angle(state):
    return state.q_s


@pytest.mark.full  # the search compiles for half a minute; tests of fits show how it ends elsewhere
def test_a_fit_of_stiffness_and_damping_from_angles():
    scheme, true = vm.fully_implicit(1), {"stiffness": 3.0, "damping": 0.15}
    run = vm.simulate(swing(true), scheme, macro_dt=0.02, num_steps=40)
    noise = 1e-4 * np.random.default_rng(0).standard_normal((41, 1))
    data = vm.fitting.Measured(run.t, run.position("hinge") + noise, sigma=1e-4, observe=angle)
    first = {"stiffness": vm.fitting.Unknown(2.0, lower=0), "damping": vm.fitting.Unknown(0.4, lower=0)}
    fit = vm.fit(swing, data, first, scheme=scheme, macro_dt=0.02)
    for name, value in true.items():
        assert abs(fit.parameters[name] - value) < 3 * fit.standard_errors[name]
        assert fit.standard_errors[name] < 0.01 * value

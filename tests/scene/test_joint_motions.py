"""Motions in joint coordinates: orders of schemes, energy over many steps, gradients of a scene's numbers."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.scene.mechanics import values
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


def run_of(scene, scheme, steps: int, t_end: float):
    """A run with 1000 saved nodes: one program for all numbers of steps."""
    return vm.simulate(scene, scheme, macro_dt=t_end / steps, num_steps=steps, save=vm.Save(number=1000))


def order(runs) -> float:
    """Of both angles along three runs, each with half the step of the one before."""
    coarse, middle, fine = (np.concatenate([run.position("shoulder"), run.position("elbow")], axis=1) for run in runs)
    return np.log2(np.linalg.norm(coarse - middle) / np.linalg.norm(middle - fine))


def test_order_and_energy_of_a_long_run():
    """2e4 steps of 0.02 s, chaotic: the error of the energy of the second half stays in the band of the first."""
    scheme = vm.fully_implicit(1)
    assert order(run_of(arm(), scheme, steps, 2.0) for steps in (1000, 2000, 4000)) == pytest.approx(2, abs=0.1)
    run = run_of(arm(), scheme, 20_000, 400.0)
    error = np.asarray(run.energy - run.energy[0])
    halves = error[1:].reshape(2, -1)
    first, second = np.abs(halves).max(axis=1)
    assert second < 1.5 * first
    assert abs(np.diff(halves.mean(axis=1))[0]) < 0.2 * first


def test_micro_steps_have_the_order_of_their_scheme():
    """A fast bar on a slow one: the spring between them is W, and is felt by its angle alone.

    Order 6 needs symmetric steps of order 2.
    """
    scheme, scene = vm.compose(vm.fully_implicit(2), "kahan-li6"), arm(stiffness=60.0, rate="fast")
    runs = [vm.simulate(scene, scheme, macro_dt=0.4 / n, num_steps=n, save=n) for n in (20, 40, 80)]
    assert order(runs) == pytest.approx(6, abs=0.3)


def swing(numbers):
    """A bar on a hinge with a spring and a damper."""
    length = numbers.get("length", 1.0)
    bar = RigidBody("bar", numbers.get("mass", 1.2), Box((1.0, 0.1, 0.2)), 0.5 * length * np.eye(3)[0], pace="slow")
    effects = [
        Revolute(("ground", "bar"), [0, 0, 0], axis=[0, 1, 0.2], name="hinge"),
        JointSpring("hinge", numbers["stiffness"], 0.2, rate="slow"),
        JointDamper("hinge", numbers["damping"]),
        Gravity([0, 0, -9.81]),
    ]
    return Scene([bar], effects, coordinates="joint").with_joints({"hinge": (0.3, 0.5)}).problem()


def test_gradients_through_length_mass_and_stiffness():
    """Of the momentum at the start, and of energies, forces and their power; derivatives of steps are in
    `tests/verification`."""

    @jax.jit
    def seen(numbers):
        problem = swing(dict(zip(("length", "mass", "stiffness"), numbers, strict=True)) | {"damping": 0.15})
        start = problem.q_s, problem.q_f, problem.v_s, problem.v_f
        kinetic, potential, power, _ = values(problem.system, 0.0, *start)
        forces = jax.grad(lambda q_s: sum(problem.system.all_potentials(q_s, problem.q_f).values()))(problem.q_s)
        return jnp.concatenate([problem.state().p_s, forces, jnp.stack([kinetic, potential, power])])

    numbers = jnp.array([1.0, 0.7, 3.0])
    slopes = jax.jit(jax.jacfwd(seen))(numbers)
    for i, step in enumerate((1e-4, 1e-4, 1e-3)):
        low, high = (seen(numbers.at[i].add(sign * step)) for sign in (-1, 1))
        assert slopes[:, i] == pytest.approx(np.asarray(high - low) / (2 * step), rel=1e-6, abs=2e-8)
        assert np.abs(slopes[:, i]).max() > 1e-2

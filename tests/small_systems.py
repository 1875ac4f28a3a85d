"""One small system of every kind: which variables there are, which constraints, which forces, which kinetic energy,
which scene.

Systems of functions have two slow and two fast variables in the plane where they have both, and share what they can.
"""

import jax.numpy as jnp
import numpy as np

import vmri_jax as vm
from vmri_jax.scene import Anchor, Body, Gravity, RigidBody, RigidLink, Scene, Spring

NONE = np.zeros(0)
STIFF = 400.0
"""Stiffness of the fast potentials; frequency 20 with unit mass."""


def soft(q_s, q_f, params):
    """Every slow variable at a soft spring, and all variables coupled softly."""
    return params["soft"] / 2 * jnp.sum(q_s**2) + params["soft"] / 4 * (jnp.sum(q_s) - jnp.sum(q_f)) ** 2


def stiff(q_f, params):
    """Every fast variable at a stiff spring."""
    return params["stiff"] / 2 * jnp.sum(q_f**2)


def kinetic(q_s, q_f, v_s, v_f, params):
    """Masses that depend on the configuration, and slow and fast velocities coupled."""
    return jnp.sum((2 + jnp.sin(q_s)) * v_s**2) + v_f @ v_f / 2 + 0.1 * jnp.cos(q_f[0]) * v_s[0] * v_f[1]


def rod(q_s, q_f, params):
    """A rod of unit length from the slow to the fast point."""
    d = q_f - q_s
    return jnp.array([d @ d - 1.0]) / 2


def circle(q_s, params):
    """The slow point on a circle about the origin."""
    return jnp.array([q_s @ q_s - 1.0]) / 2


def moving_rod(t, q_s, q_f, params):
    """A rod whose end on the slow point swings."""
    d = q_f - q_s - jnp.stack([0.1 * jnp.sin(3 * t), jnp.zeros_like(t)])
    return jnp.array([d @ d - 1.0]) / 2


def moving_circle(t, q_s, params):
    """A circle that swings."""
    d = q_s - jnp.stack([0.1 * jnp.sin(3 * t), jnp.zeros_like(t)])
    return jnp.array([d @ d - 1.0]) / 2


def damping(t, q_s, q_f, v_s, v_f, params):
    """Linear damping."""
    return -0.1 * v_s, -0.2 * v_f


def drive(t, q_s, q_f, v_s, v_f, params):
    """A force in time on the slow variables."""
    return jnp.sin(3 * t) * jnp.ones_like(q_s), jnp.zeros_like(q_f)


PARAMS = {"soft": 4.0, "stiff": STIFF}
SLOW, FAST = np.array([1.0, 0.0]), np.array([0.02, -0.01])
"""Starts; the slow one lies on the circle."""
ANGLE = 0.1
HANGING = SLOW - np.array([np.cos(ANGLE), np.sin(ANGLE)])
ACROSS = 0.5 * np.array([np.sin(ANGLE), -np.cos(ANGLE)])
"""The fast end of a rod from the slow point, near the rest of its spring, and a velocity across the rod: a gentle
motion."""


def _system(masses, *potentials, **parts) -> vm.System:
    return vm.System(masses, *potentials, params={name: np.asarray(x) for name, x in PARAMS.items()}, **parts)


BOTH = vm.ConstantMass([2.0, 2.0], [1.0, 1.0])


def slow_alone() -> vm.Problem:
    return vm.Problem(_system(vm.ConstantMass([2.0, 2.0], NONE), soft), SLOW, NONE, [0.0, 1.0], NONE)


def fast_alone() -> vm.Problem:
    return vm.Problem(_system(vm.ConstantMass(NONE, [1.0, 1.0]), None, stiff), NONE, FAST, NONE, [1.0, 0.0])


def one_coordinate() -> vm.Problem:
    return vm.Problem(_system(vm.ConstantMass([2.0], NONE), soft), [1.0], NONE, [0.0], NONE)


def no_constraint() -> vm.Problem:
    return vm.Problem(_system(BOTH, soft, stiff), SLOW, FAST, [0.0, 0.3], [1.0, 0.0])


def constraint() -> vm.Problem:
    return vm.Problem(_system(BOTH, soft, stiff, constraint=rod), SLOW, HANGING, [0.0, 0.0], ACROSS)


def slow_constraint() -> vm.Problem:
    return vm.Problem(_system(BOTH, soft, stiff, slow_constraint=circle), SLOW, FAST, [0.0, 0.5], [1.0, 0.0])


def both_constraints() -> vm.Problem:
    system = _system(BOTH, soft, stiff, constraint=rod, slow_constraint=circle)
    return vm.Problem(system, SLOW, HANGING, [0.0, 0.0], ACROSS)


def moving_constraints() -> vm.Problem:
    system = _system(
        BOTH, soft, stiff, constraint=vm.Rheonomic(moving_rod), slow_constraint=vm.Rheonomic(moving_circle)
    )
    return vm.Problem(system, SLOW, HANGING, [0.3, 0.0], np.array([0.6, 0.0]) + ACROSS)


def damped() -> vm.Problem:
    return vm.Problem(_system(BOTH, soft, stiff, force=damping), SLOW, FAST, [0.0, 0.3], [1.0, 0.0])


def driven() -> vm.Problem:
    return vm.Problem(_system(BOTH, soft, stiff, force=drive), SLOW, FAST)


def kinetic_function() -> vm.Problem:
    return vm.Problem(_system(kinetic, soft, stiff), SLOW, FAST, [0.0, 0.3], [1.0, 0.0])


def scene_of_points() -> Scene:
    return Scene(
        [Body("hook", 5.0, [0.0, -1.0], pace="slow"), Body("load", 1.0, [0.4, -1.3], pace="fast")],
        [Gravity(), Anchor("hook", [0.0, 0.0]), Spring(("hook", "load"), STIFF, 0.5)],
    )


def scene_of_rigid_bodies() -> Scene:
    return Scene(
        [
            RigidBody("hub", 5.0, [1.0, 2.0, 2.5], np.zeros(3), spin=[0.1, 0.0, 0.5], pace="slow"),
            Body("tip", 1.0, [1.2, 0.0, 0.0], pace="fast"),
        ],
        [Spring(("hub", "tip"), STIFF, 1.0)],
    )


def scene_without_fast_bodies() -> Scene:
    return Scene(
        [Body("pivot", 5.0, [0.0, -1.0], pace="slow"), Body("bob", 1.0, [0.6, -1.8], pace="slow")],
        [Gravity(), Anchor("pivot", [0.0, 0.0]), RigidLink(("pivot", "bob"))],
    )


SYSTEMS = {
    make.__name__: make()
    for make in (
        slow_alone,
        fast_alone,
        one_coordinate,
        no_constraint,
        constraint,
        slow_constraint,
        both_constraints,
        moving_constraints,
        damped,
        driven,
        kinetic_function,
        scene_of_points,
        scene_of_rigid_bodies,
        scene_without_fast_bodies,
    )
}

"""Closed loops in joint coordinates, random ones and a slider-crank: the same mechanics and reaction forces as by
directors."""

from typing import Any

import jax
import numpy as np
import pytest

from benchmarks.body_motions import accelerations, state_of
from tests.scene.mechanics import state_by_directors
from tests.scene.random_trees import random_ring
from vmri_jax.mechanics.motion import reaction_forces
from vmri_jax.scene import Box, Gravity, Prismatic, Revolute, RigidBody, Scene

X, _, Z = np.eye(3)
GROUNDED = 3
"""Seed of a ring that the ground closes, with joints of three kinds."""


@pytest.mark.parametrize(
    "seed", [GROUNDED, *(pytest.param(seed, marks=pytest.mark.full) for seed in range(7) if seed != GROUNDED)]
)
def test_bodies_of_random_rings_accelerate_as_by_directors(seed):
    scene, starts = random_ring(seed)
    first = next(branch.joint.name for branch in scene.branches if branch.joint.freedoms)
    freedom, start = next(iter(starts[first].items()))
    scene = scene.with_joints({first: {freedom: start}})
    assert sum(scene.system().num_constraints(*scene.start[:2])) > 0
    mine = accelerations(scene, state_of(scene))
    theirs = accelerations(*state_by_directors(scene, mine))
    for name in theirs:
        for a, b in zip(mine[name], theirs[name], strict=True):
            np.testing.assert_allclose(a, b, atol=1e-10)  # values up to 10, measured 3e-14


def slider_crank():
    """A crank that turns, a rod and a piston, in a plane."""
    pin, wrist = np.array([0.3, 0.4, 0]), np.array([1.5, 0, 0])
    bodies = [
        RigidBody("crank", 2.0, Box((0.5, 0.1, 0.1)), pin / 2, [0, 0, np.arctan2(4, 3)], pace="slow"),
        RigidBody("rod", 1.0, Box((1.26, 0.05, 0.05)), (pin + wrist) / 2, [0, 0, np.arctan2(-4, 12)], pace="slow"),
        RigidBody("piston", 0.8, Box((0.2, 0.2, 0.2)), wrist, pace="slow"),
    ]
    joints = [
        Revolute(("ground", "crank"), [0, 0, 0], axis=Z, name="bearing"),
        Revolute(("crank", "rod"), pin, axis=Z, name="crank pin"),
        Revolute(("rod", "piston"), wrist, axis=Z, name="wrist pin"),
        Prismatic(("ground", "piston"), wrist, axis=X, name="cylinder"),
    ]
    scene = Scene(bodies, [Gravity([0, -9.81, 0]), *joints], coordinates="joint", redundant="drop")
    return scene.with_rates({"bearing": 5.0})


def test_reaction_forces_of_a_slider_crank():
    """The balance of each body in joint coordinates, by the angles and accelerations alone, has the forces that
    multipliers give by directors.

    Nine equations in the plane for eight unknowns: two forces in each hinge, a force and a moment in the cylinder.
    """
    scene, names = slider_crank(), ("crank", "rod", "piston")
    moved = accelerations(scene, state_of(scene))
    twin, state = state_by_directors(scene, moved)
    centres = np.array([moved[name][0][:2] for name in names])
    pins = np.array(
        [[0, 0], 2 * centres[0], centres[2]]
    )  # where the hinges are, of a crank whose centre is in its middle
    equations, known = np.zeros((9, 8)), np.zeros(9)

    def lever(pin, body):
        """Of the moment of a force about the centre of a body."""
        x, y = pins[pin] - centres[body]
        return np.array([-y, x])

    for body, name in enumerate(names):
        q, _, a = moved[name]
        turning = np.cross(q[3:].reshape(3, 3), a[3:].reshape(3, 3)).sum(axis=0)[2] / 2  # sum d_i x d_i'' / 2
        made: Any = scene.by_name[name]
        known[3 * body : 3 * body + 3] = [made.mass * a[0], made.mass * (a[1] + 9.81), made.moments[2] * turning]
        for pin, sign in ((body, 1.0), (body + 1, -1.0)):
            if pin < 3:
                equations[3 * body : 3 * body + 2, 2 * pin : 2 * pin + 2] = sign * np.eye(2)
                equations[3 * body + 2, 2 * pin : 2 * pin + 2] = sign * lever(pin, body)
    equations[7, 6] = equations[8, 7] = 1.0
    forces, residual, *_ = np.linalg.lstsq(equations, known, rcond=None)
    assert residual < 1e-20
    forces_of = jax.jit(reaction_forces)
    for joint, name, mine in (("crank pin", "rod", forces[2:4]), ("cylinder", "piston", [0.0, forces[6]])):
        rows = twin.names.rows
        chosen = np.isin(np.arange(sum(map(len, rows.values()))), rows[joint])
        (theirs,), _ = forces_of(twin.system(), (state, chosen[None]))
        start = twin.places[name].start
        np.testing.assert_allclose(theirs[start : start + 2], mine, atol=1e-8)  # N, values of 10 to 100

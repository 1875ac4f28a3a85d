"""Random closed loops in joint coordinates: the same mechanics as by directors."""

import pytest

from tests.scene.random_trees import random_ring
from tests.scene.test_joint_coordinates import assert_accelerates_as_by_directors

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
    assert_accelerates_as_by_directors(scene)

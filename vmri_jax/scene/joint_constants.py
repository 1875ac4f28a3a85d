"""The constants of joints that carry bodies, from which the kinematics compute the places of these bodies.

For the letters see `vmri_jax.mechanics.kinematics`.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vmri_jax.mechanics.arrays import library
from vmri_jax.scene.body import Bodies, body_of
from vmri_jax.scene.trees import Branch


def joint_constants(bodies: Bodies, branches: Sequence[Branch]) -> dict[str, Any]:
    """The constants "turn", "slide" and "zero" of the branches, see `Kinematics`, in the axes of their roots."""
    on_joints = {branch.child: branch for branch in branches}
    zeros, turns, slides = [], [], []
    for branch in branches:
        root, shift = _root(branch, on_joints)
        centre, directors = _frame(bodies, root)
        origin, axes = _frame(bodies, branch.child)
        # a vector y in space has the components y D^T along the directors of the root, the rows of D
        place = origin + shift - centre
        zeros.append(library(place, axes).concatenate([place[None], axes]) @ directors.T)
        point = (branch.points[1] + shift - centre) @ directors.T
        for move, _ in branch.moves:
            axis = branch.sign * branch.joint.triads[branch.element][move.axis] @ directors.T
            pitch = branch.joint.pitch_of(branch.element) / (2 * np.pi)
            turns.append((move.kind != "slide") * _turn(axis, point))
            slides.append({"turn": 0.0, "slide": 1.0, "screw": pitch}[move.kind] * axis)
    xp = library(zeros, turns, slides)
    of_links = {"turn": xp.reshape(xp.asarray(turns), (-1, 4, 3)), "slide": xp.reshape(xp.asarray(slides), (-1, 3))}
    return of_links | {"zero": xp.stack(zeros)}


def _root(branch: Branch | None, on_joints: Mapping[str, Branch]) -> tuple[str, Any]:
    """The root of a child, and the displacement of the child from its place as the user gave it to its place at x = 0.

    There both points of each joint coincide. As the user gave them they differ by round-off, or by the numbers that a
    derivative varies.
    """
    shift, name = np.zeros(3), ""
    while branch is not None:
        (of_parent, of_child), name = branch.points, branch.parent
        shift, branch = shift + of_parent - of_child, on_joints.get(name)
    return name, shift


def _frame(bodies: Bodies, name: str) -> tuple[Any, Any]:
    """Centre (3,) and directors (3, 3) of a body as the user gave them."""
    rows = body_of(bodies, name).coordinates.reshape(4, 3)  # pyright: ignore[reportAttributeAccessIssue]
    return rows[0], rows[1:]


def _turn(axis, point):
    """(4, 3) the twist T of a turn about an axis through a point: the velocity ``axis x (y - point)`` of a point y."""
    xp = library(axis, point)
    return xp.cross(axis, xp.concatenate([-point[None], xp.eye(3)]))

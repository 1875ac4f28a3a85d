"""The constants of joints that carry bodies, from which the kinematics compute the frames of these bodies.

For the letters see `vmri_jax.mechanics.kinematics`.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from vmri_jax.mechanics.arrays import library
from vmri_jax.mechanics.kinematics import UNMOVED
from vmri_jax.scene.body import Bodies, body_of
from vmri_jax.scene.rigid import RigidBody
from vmri_jax.scene.trees import Link


def joint_constants(bodies: Bodies, links: Sequence[Link | None]) -> dict[str, Any]:
    """The constants C, P, S, E (n, 4, 3) of all links, see `vmri_jax.mechanics.kinematics`.

    The rows (r, M) of a frame are ``C + P cos x + S sin x + E x``. A link of None gets the constants of a frame that does not move.
    """
    frames = list(dict.fromkeys(link for link in links if link is not None))
    ends = _ends(bodies, frames)
    xp = library(ends)
    # triads in cyclic order with the axis of the motion last, so that the turn is in the first two rows
    axes = [link.move.axis if link.move else 2 for link in frames]
    cyclic = np.array([[(k + 1) % 3, (k + 2) % 3, k] for k in axes])
    inner, outer = (ends[name][np.arange(len(frames))[:, None], cyclic] for name in ("frame_a", "frame_b"))

    def dyads(i: int, j: int):
        """``f_i^T a_j`` with the rows f of F_b and a of F_a."""
        return outer[:, i, :, None] * inner[:, j, None, :]

    def rows(matrix, point):
        """(r, M) with ``r = X - X_b M``."""
        rotated = xp.sum(ends["point_b"][:, :, None] * matrix, axis=1)
        return xp.concatenate([(point - rotated)[:, None], matrix], axis=1)

    turns, slides = (np.array([link.amount(kind) for link in frames])[:, None, None] for kind in ("turn", "slide"))
    pitches = [link.branch.joint.pitch_of(link.branch.element) / (2 * np.pi) for link in frames]
    screws = library(pitches).stack(pitches)[:, None]
    # M = F_b^T T(x) F_a = f_2^T a_2 + cos x (f_0^T a_0 + f_1^T a_1) + sin x (f_0^T a_1 - f_1^T a_0); without a turn cos x = 1
    across, along = dyads(0, 0) + dyads(1, 1), dyads(2, 2)
    zero = xp.zeros_like(ends["point_a"])
    constants = {
        "constant": rows(along + (1 - np.abs(turns)) * across, ends["point_a"]),
        "cosine": rows(np.abs(turns) * across, zero),
        "sine": rows(turns * (dyads(0, 1) - dyads(1, 0)), zero),
        "way": xp.pad(((slides[:, 0] + turns[:, 0] * screws) * inner[:, 2])[:, None], ((0, 0), (0, 3), (0, 0))),
    }
    numbers = np.array([len(frames) if link is None else frames.index(link) for link in links])
    unmoved = {name: UNMOVED if name == "constant" else np.zeros((4, 3)) for name in constants}
    return {name: xp.concatenate([values, unmoved[name][None]])[numbers] for name, values in constants.items()}


def _ends(bodies: Bodies, links: Sequence[Link]) -> dict[str, Any]:
    """The points X and triads F of all links: "point_a", "frame_a" in the frame that a link hangs on, "point_b", "frame_b" in its own."""
    carried = {link.branch.child for link in links}
    ends: dict[str, list] = {}
    for link in links:
        branch = link.branch
        point, triad = (of_pairs[branch.element] for of_pairs in (branch.joint.joining_points, branch.joint.triads))
        of_parent, of_child = (0, 1) if branch.forward else (1, 0)
        for role, name, number, is_body in (
            ("a", branch.parent, of_parent, link.step == 0),
            ("b", branch.child, of_child, link.step + 1 == branch.size),
        ):
            body = body_of(bodies, name)
            # a root has only the directors in `wide`, a carried body all three, as rows of its frame
            components = body.components if isinstance(body, RigidBody) and name in carried else body.weights
            # a frame between two moves of a joint is the triad itself, with its origin at the point of the joint
            x = components((point[number] - body.position) @ body.rotation) if is_body else np.zeros(3)
            axes = [components(row @ body.rotation) for row in triad] if is_body else list(np.eye(3))
            ends.setdefault(f"point_{role}", []).append(x)
            ends.setdefault(f"frame_{role}", []).append(library(axes).stack(axes))
    return {name: library(values).stack(values) for name, values in ends.items()}

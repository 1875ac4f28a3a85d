"""Trees of bodies on joints: which joints carry a body as a function of their freedoms, and which close loops.

A joint whose freedoms are coordinates without a singularity may carry a body. In each loop of such joints one joint
closes the loop: it carries no body, and its rows stay constraints. Prim's algorithm chooses these joints. It grows a
spanning tree from the ground, and from a body of each mechanism that is not tied to the ground: a body with the pace
"slow", then the one with most directors, then the heaviest. It adds joints in this order: joints whose whole turns an
effect counts, since an angle of directors has none; joints in which another effect acts; joints with few freedoms, so
that the joints left over have few rows; joints near the root, so that trees are not deep. Names decide among equals:
the order in which bodies and joints are listed has no influence.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from heapq import heappop, heappush
from itertools import count
from typing import Any, NamedTuple

import numpy as np

from vmri_jax.mechanics.arrays import is_concrete, library
from vmri_jax.mechanics.kinematics import SIZE, Carried, Kinematics, Link
from vmri_jax.mechanics.rows import Part, Place
from vmri_jax.refusals import Refused
from vmri_jax.scene.binding import DecidedPace, Key, Layout
from vmri_jax.scene.body import GROUND, Bodies, Frame, body_of
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.effects.joint_base import ANGLES, AXES_OF, Joint, OfFreedoms
from vmri_jax.scene.rigid import RigidBody
from vmri_jax.scene.terms import split

LONGEST = 100
"""Most bodies between the root and a leaf of a tree for which coordinates="auto" chooses joint coordinates. The kinetic
energy couples all joints of a tree, so that the time of a step grows at last with the third power of this length; by
directors it grows in proportion. On a hinged chain of 30 bars a step in joint coordinates takes 0.18 of the time by
directors, on 100 bars 0.25 of it."""
JOINTS_OF_A_LOOP = 5
"""Fewest joints for each loop of a scene for which coordinates="auto" chooses joint coordinates. In denser loops the
constraints of the cut joints take away most of the coordinates, and each depends on all joints of its loop: in a row of
six four-bars, with 3.2 joints for each loop, a step in joint coordinates takes 0.13 of the time by directors, and the
first result, nearly all of it compiling, 1.5 times as long; of two four-bars 3 times."""
COUNTED, USED, UNUSED = range(3)
"""Ranks of a pair of bodies in a joint: an effect counts whole turns of its angle, an effect acts in it, none does."""


class Branch(NamedTuple):
    """A body (the child) that a joint carries, and the body or ground (the parent) that it hangs on.

    element: number of the pair of bodies in the joint.
    forward: whether the child is the second body of this pair.
    """

    child: str
    parent: str
    joint: Joint
    element: int
    forward: bool

    @property
    def keys(self) -> list[Key]:
        """The freedoms of the joint, as keys of `Layout.freedoms`."""
        return [(self.joint.name, self.element, freedom) for freedom in self.joint.freedoms]

    @property
    def labels(self) -> list[str]:
        """The names of the coordinates of the joint."""
        return [self.joint.label(self.element, freedom) for freedom in self.joint.freedoms]

    @property
    def way(self) -> list[Key]:
        """The freedoms in the order from the parent to the child."""
        # the motions are defined from body a to body b of the joint; a child that is body a undoes them, the last one
        # first
        return self.keys[:: 1 if self.forward else -1]

    @property
    def points(self) -> tuple[Any, Any]:
        """The point of the joint in space, as the parent has it and as the child has it, (3,) at the start."""
        a, b = self.joint.joining_points[self.element]
        return (a, b) if self.forward else (b, a)


def grow(bodies: Bodies, effects: Sequence[Effect], everywhere: bool = True) -> tuple[Branch, ...]:
    """The branches of all trees, parents first; if not `everywhere`, without those where directors are faster."""
    ranks = _ranks(effects)
    by_parent = _offers(bodies, effects, ranks)
    branches, tree_of, deepest = [], {}, {}
    for root in sorted(by_parent, key=lambda name: (*_root_rank(name, bodies), name)):
        waiting: list[tuple] = [((), 0, (), root, root, None)]
        while waiting:
            _, depth, _, name, tree, branch = heappop(waiting)
            if name in tree_of:
                continue
            tree_of[name], deepest[tree] = tree, max(depth, deepest.get(tree, 0))
            branches += [branch] if branch else []
            for order, names, following in by_parent[name]:
                # each body on the ground is the root of a tree of its own: the ground does not couple their coordinates
                child = following.child
                heappush(waiting, (order, depth + 1, names, child, child if name == GROUND else tree, following))
    if everywhere:
        return tuple(branches)
    num_joints = sum(map(len, by_parent.values())) // 2
    is_dense = num_joints < JOINTS_OF_A_LOOP * (num_joints - len(branches))
    return tuple(
        branch
        for branch in branches
        if (not is_dense and deepest[tree_of[branch.child]] <= LONGEST)
        or ranks.get((branch.joint.name, branch.element)) == COUNTED
        or any(isinstance(bodies.get(name), Frame) for name in (branch.child, branch.parent))
    )


def _offers(bodies: Bodies, effects: Sequence[Effect], ranks: Mapping) -> dict[str, list[tuple]]:
    """For each body all branches that may hang on it, as (sort key, best first; sort key among equals; branch)."""
    by_parent, number = defaultdict(list), count()
    for joint in (effect for effect in effects if isinstance(effect, Joint) and effect.carries):
        for i, (a, b) in enumerate(joint.elements):
            if a != b and all(name == GROUND or (name in bodies and bodies[name].rigid) for name in (a, b)):
                order = ranks.get((joint.name, i), UNUSED), len(joint.freedoms)
                names = joint.name, *sorted((a, b)), next(number)
                by_parent[a].append((order, names, Branch(b, a, joint, i, True)))
                by_parent[b].append((order, names, Branch(a, b, joint, i, False)))
    return by_parent


def _ranks(effects: Sequence[Effect]) -> dict[tuple[str, int], int]:
    """`COUNTED` or `USED` for each (joint, number of its pair) in which an effect acts."""
    ranks: dict[tuple[str, int], int] = {}
    for effect in (effect for effect in effects if isinstance(effect, OfFreedoms)):
        for i in range(len(effect.elements)):
            for joint, pair, freedom in effect.freedoms_of(i):
                rank = COUNTED if effect.counts_turns and freedom in ANGLES else USED
                ranks[joint, pair] = min(rank, ranks.get((joint, pair), rank))
    return ranks


def _root_rank(name: str, bodies: Bodies) -> tuple:
    """Sort key, the best root first: the ground, bodies with the pace "slow", with all three directors, with a large
    mass."""
    if name == GROUND:
        return (False,)
    body = bodies[name]
    mass = float(body.mass or 0.0) if is_concrete(body.mass) else 0.0
    return True, body.pace != "slow", -len(body.wide), -mass


def check_frames(bodies: Bodies, branches: Sequence[Branch]) -> None:
    """Refuse frames that hang on no joint, or that carry no body; there are no branches if all bodies have
    directors."""
    hanging, carrying = ({getattr(branch, end) for branch in branches} for end in ("child", "parent"))
    for name, body in bodies.items():
        if not isinstance(body, Frame):
            continue
        if not branches:
            raise Refused(
                f"Scene: {name} is a frame without mass, which moves with joints alone, not by directors; give the "
                'scene coordinates="joint". For reaction forces, join bodies by Universal, Cylindrical or Planar, or '
                "put a body of small mass in place of the frame."
            )
        if name not in hanging or name not in carrying:
            lack = f"no joint carries the frame {name}" if name not in hanging else f"the frame {name} carries no body"
            raise Refused(
                f"Scene: {lack}, and it has no mass; join it to the body that it hangs on and to a body that it "
                "carries by joints with coordinates, such as Revolute, or leave it out."
            )


def with_weight(bodies: Bodies, branches: Sequence[Branch]) -> Bodies:
    """The bodies, with rigid bodies like the ones they carry for frames: frequencies are estimated by this inertia."""
    weighted = dict(bodies)
    for branch in reversed(branches):  # children first: a frame may carry a frame
        frame, child = bodies.get(branch.parent), weighted[branch.child]
        if isinstance(frame, Frame) and isinstance(child, RigidBody):
            # a frame has three directors, also if it carries a rod or a plate
            moments = child.moments if len(child.wide) == 3 else np.full(3, child.moments.mean())
            weighted[frame.name] = RigidBody(frame.name, child.mass, moments, frame.position, pace=frame.pace)
    return weighted


def make_layout(
    bodies: Bodies, paces: Mapping[str, DecidedPace], branches: Sequence[Branch] = ()
) -> tuple[Layout, tuple[Branch, ...]]:
    """The places of all coordinates in q_s and q_f, and the branches in the order of the kinematics.

    A body on a joint has the freedoms of this joint as coordinates.
    """
    ends: dict[Part, int] = {"s": 0, "f": 0}
    on_joints = {branch.child: branch for branch in branches}
    coordinates, places, freedoms = {}, {}, {}

    def following(part: Part, size: int) -> Place:
        ends[part] += size
        return Place(part, ends[part] - size, size)

    for name, body in bodies.items():
        part: Part = "f" if paces[name].value == "fast" else "s"
        branch = on_joints.get(name)
        if branch is None:
            coordinates[name] = places[name] = following(part, body.size)
            continue
        for key, label in zip(branch.keys, branch.labels, strict=True):
            coordinates[label] = freedoms[key] = following(part, 1)
    if not branches:
        return Layout(places, coordinates), ()
    kinematics, ordered = _kinematics(branches, places, freedoms, (ends["s"], ends["f"]))
    places |= {b.child: following(body.part, SIZE) for b, body in zip(ordered, kinematics.bodies, strict=True)}
    return Layout({name: places[name] for name in bodies}, coordinates, freedoms, kinematics), ordered


def _kinematics(branches: Sequence[Branch], places, freedoms, sizes) -> tuple[Kinematics, tuple[Branch, ...]]:
    """The kinematics of the branches, parents first, and the branches in the order of its bodies.

    `places` are of the bodies on no joint.
    """
    fast = {name for name, place in places.items() if place.part == "f"}  # bodies that depend on fast coordinates
    for branch in branches:
        if branch.parent in fast or any(freedoms[key].part == "f" for key in branch.keys):
            fast.add(branch.child)
    carriers: set[str] = set()  # the bodies that carry, at any depth, fast ones
    for branch in reversed(branches):
        if branch.child in fast or branch.child in carriers:
            carriers.add(branch.parent)
    ordered = sorted(branches, key=lambda branch: 2 if branch.child in fast else branch.child in carriers)
    ends = np.cumsum([len(branch.keys) for branch in ordered]).tolist()
    firsts = {branch.child: end - len(branch.keys) for branch, end in zip(ordered, ends, strict=True)}
    numbers = {name: i for i, name in enumerate(dict.fromkeys(b.parent for b in branches if b.parent in places))}
    numbers[GROUND] = -1
    links, lasts = {}, {}
    for branch in branches:
        numbers[branch.child] = numbers[branch.parent]
        last = lasts.get(branch.parent, -1)
        for number, key in enumerate(branch.way, firsts[branch.child]):
            links[number], last = Link(freedoms[key], last, key[2] in ANGLES), number
        lasts[branch.child] = last
    carried = (Carried("f" if b.child in fast else "s", numbers[b.child], lasts[b.child]) for b in ordered)
    roots = tuple(places[name] for name in numbers if name in places)
    return Kinematics(roots, tuple(links[i] for i in range(len(links))), tuple(carried), sizes), tuple(ordered)


def joint_constants(bodies: Bodies, branches: Sequence[Branch]) -> dict[str, Any]:
    """The constants "turn", "slide" and "zero" of the branches, see `Kinematics` with its letters, in the axes of their
    roots."""
    on_joints = {branch.child: branch for branch in branches}
    zeros, turns, slides = [], [], []
    for branch in branches:
        root, shift = _root(branch, on_joints)
        centre, directors = split(body_of(bodies, root).coordinates)
        origin, axes = split(body_of(bodies, branch.child).coordinates)
        # a vector y in space has the components y D^T along the directors of the root, the rows of D
        place = origin + shift - centre
        zeros.append(library(place, axes).concatenate([place[None], axes]) @ directors.T)
        point = (branch.points[1] + shift - centre) @ directors.T
        # of a screw: how far b moves along the axis per turn, m
        pitch = branch.joint.params_of((branch.element,)).get("pitch", 0.0) / (2 * np.pi)
        for *_, freedom in branch.way:
            # a positive value of a freedom moves body b of the joint along its axis
            axis = (
                (1.0 if branch.forward else -1.0) * branch.joint.triads[branch.element][AXES_OF[freedom]] @ directors.T
            )
            turns.append((freedom in ANGLES) * _turn(axis, point))
            slides.append((pitch if freedom in ANGLES else 1.0) * axis)
    xp = library(zeros, turns, slides)
    # in matrices (4, 4), see `vmri_jax.mechanics.kinematics`
    rows = xp.reshape(xp.asarray(turns), (-1, 4, 3)), xp.reshape(xp.asarray(slides), (-1, 1, 3)), xp.stack(zeros)
    turn, slide, zero = (xp.pad(x, ((0, 0), (0, 4 - x.shape[1]), (1, 0))) for x in rows)
    return {"turn": turn, "slide": slide, "zero": zero + np.diag([1.0, 0, 0, 0])}


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


def _turn(axis, point):
    """(4, 3) the twist T of a turn about an axis through a point: the velocity ``axis x (y - point)`` of a point y."""
    xp = library(axis, point)
    return xp.cross(axis, xp.concatenate([-point[None], xp.eye(3)]))

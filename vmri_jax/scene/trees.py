"""Trees of bodies on joints: which joints carry a body as a function of their freedoms, and which close loops.

Every joint whose freedoms are coordinates without a pole may carry a body. Of those that form a loop one is cut: its rows stay as
constraints. A spanning tree that grows from the ground, or from a body of what floats (one that is said to be slow, or else the heaviest), takes the joint with the most rows first
(Prim's algorithm), so that the fewest rows are left, and the one nearest to the root among equals, so that trees are not deep.
"""

from collections.abc import Mapping, Sequence
from heapq import heappop, heappush
from itertools import count
from typing import Any, Literal, NamedTuple

import numpy as np

from vmri_jax.mechanics.arrays import is_concrete, library
from vmri_jax.mechanics.kinematics import UNMOVED, Frames, Grid, Kinematics, Move
from vmri_jax.mechanics.rows import Part, Place, Rows
from vmri_jax.scene.body import GROUND, Bodies, Frame, body_of
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.effects.joints import Joint
from vmri_jax.scene.layout import Layout, Pace
from vmri_jax.scene.rigid import RigidBody

LONGEST = 50
"""Bodies on a way from the root of a tree, up to which joint coordinates are chosen by themselves. All joints of a tree are coupled by its
kinetic energy, so that their time for a step grows nearly with the third power of the length; by directors it grows with the first. With a
hinged chain of 30 bars joints take 0.45 of the time of directors, with 100 bars 2.9 times as long."""


class Branch(NamedTuple):
    """A body that hangs on another one, or on the ground, by a pair of a joint.

    element: number of the pair.
    forward: whether the body is the second one of the pair.
    """

    child: str
    parent: str
    joint: Joint
    element: int
    forward: bool

    @property
    def size(self) -> int:
        """Number of frames from the parent to the child, the latter included."""
        return max(1, len(self.joint.moves))

    @property
    def keys(self) -> list[tuple[str, int, str]]:
        """Its freedoms as keys of `Layout.freedoms`."""
        return [(self.joint.name, self.element, freedom) for freedom in self.joint.freedoms]

    def labels(self, bodies: Bodies) -> list[str]:
        """What its coordinates are called."""
        name = self.joint.label(self.element, bodies)
        freedoms = self.joint.freedoms
        return [name] if len(freedoms) == 1 else [f"{name} {freedom}" for freedom in freedoms]


class Link(NamedTuple):
    """A frame of a tree that hangs on another one: the body of a branch, or a frame between two moves of its joint.

    step: number of its move, from the parent of the branch on.
    """

    branch: Branch
    step: int

    @property
    def is_first(self) -> bool:
        """Whether it hangs on a body."""
        return self.step == 0

    @property
    def is_last(self) -> bool:
        """Whether it is a body."""
        return self.step + 1 >= len(self.branch.joint.moves)

    @property
    def coordinate(self) -> int | None:
        """Number of its move among those of the joint; None of one that leaves nothing free."""
        count = len(self.branch.joint.moves)
        return None if not count else self.step if self.branch.forward else count - 1 - self.step

    @property
    def move(self) -> Move | None:
        """What its coordinate does."""
        return None if self.coordinate is None else self.branch.joint.moves[self.coordinate]

    @property
    def key(self) -> tuple[str, int, str] | None:
        """Its freedom as a key of `Layout.freedoms`."""
        return None if self.coordinate is None else self.branch.keys[self.coordinate]

    def amount(self, kind: Literal["turn", "slide"]) -> float:
        """1 or -1, forwards or backwards, where its coordinate turns or slides like this, else 0."""
        kinds = ("turn", "screw") if kind == "turn" else ("slide",)
        sign = 1.0 if self.branch.forward else -1.0
        return sign if self.move is not None and self.move.kind in kinds else 0.0

    @property
    def pitch(self):
        """How far it moves along the axis in a turn, m; zero unless it is a screw."""
        return self.branch.joint.pitch_of(self.branch.element)


def grow(bodies: Bodies, effects: Sequence[Effect]) -> tuple[Branch, ...]:
    """The branches of all trees, parents before children.

    Args:
        bodies: by name.
        effects: joints among them.
    """
    edges: dict[str, list[tuple]] = {}
    for joint in (effect for effect in effects if isinstance(effect, Joint) and effect.carries):
        for i, (a, b) in enumerate(joint.elements(bodies)):
            if body_of(bodies, a).rigid and body_of(bodies, b).rigid:
                edges.setdefault(a, []).append((b, joint, i, True))
                edges.setdefault(b, []).append((a, joint, i, False))
    found, reached, order = [], set(), count()
    for root in (GROUND, *sorted(edges, key=lambda name: _as_root(name, bodies))):
        if root not in edges or root in reached:
            continue
        reached.add(root)
        waiting: list[tuple] = []

        def offer(parent: str, depth: int, waiting=waiting):
            for child, joint, i, forward in edges[parent]:
                if child not in reached:
                    heappush(waiting, (len(joint.moves), depth, next(order), Branch(child, parent, joint, i, forward)))

        offer(root, 1)
        while waiting:
            _, depth, _, branch = heappop(waiting)
            if branch.child not in reached:
                reached.add(branch.child)
                found.append(branch)
                offer(branch.child, depth + 1)
    return tuple(found)


def shallow(branches: Sequence[Branch]) -> tuple[Branch, ...]:
    """The branches of trees on whose ways at most `LONGEST` bodies follow each other.

    Args:
        branches: of all trees, parents before children.
    """
    depths: dict[str, int] = {}
    roots: dict[str, str] = {}
    for branch in branches:
        depths[branch.child] = depths.get(branch.parent, 0) + 1
        # on the ground each body that hangs on it begins a tree of its own
        roots[branch.child] = branch.child if branch.parent == GROUND else roots.get(branch.parent, branch.parent)
    deepest: dict[str, int] = {}
    for name, depth in depths.items():
        deepest[roots[name]] = max(depth, deepest.get(roots[name], 0))
    return tuple(branch for branch in branches if deepest[roots[branch.child]] <= LONGEST)


def _as_root(name: str, bodies: Bodies) -> tuple:
    """The smaller, the better a body is a root: one that is said to be slow, that has all directors, that is heavy."""
    if name == GROUND:
        return (False,)
    body = bodies[name]
    mass: Any = getattr(body, "mass", 0.0)
    return True, body.pace != "slow", -len(body.wide), -float(mass) if is_concrete(mass) else 0.0


def check_frames(bodies: Bodies, branches: Sequence[Branch]) -> None:
    """Refuse frames that hang on no joint, or that carry nothing.

    Args:
        bodies: by name.
        branches: of all trees; () by directors.

    Raises:
        ValueError: with the name of the frame.
    """
    hanging, carrying = ({getattr(branch, end) for branch in branches} for end in ("child", "parent"))
    for name, body in bodies.items():
        if not isinstance(body, Frame):
            continue
        if not branches:
            raise ValueError(
                f'Scene: {name} is a frame without mass, which moves with joints alone; give the scene coordinates="joint".'
            )
        if name not in hanging or name not in carrying:
            where = "hangs on no body, by no joint that may carry it," if name not in hanging else "carries no body"
            raise ValueError(
                f"Scene: the frame {name} {where} and has no mass of its own; tie it to what it hangs on and to what it carries by joints "
                "with coordinates, such as Revolute, or leave it out."
            )


def with_weight(bodies: Bodies, branches: Sequence[Branch]) -> Bodies:
    """The bodies with frames as heavy as what they carry: so frequencies of what acts on them can be estimated.

    Args:
        bodies: by name.
        branches: of all trees, parents before children.
    """
    found = dict(bodies)
    for branch in reversed(branches):
        frame, carried = bodies.get(branch.parent), found[branch.child]
        if isinstance(frame, Frame) and isinstance(carried, RigidBody):
            found[frame.name] = RigidBody(frame.name, carried.mass, carried.moments, frame.position, pace=frame.pace)
    return found


def layout(
    bodies: Bodies, paces: Mapping[str, Pace], branches: Sequence[Branch] = ()
) -> tuple[Layout, tuple[Link | None, ...]]:
    """The places of all bodies: slow ones in order in q_s, fast ones in order in q_f; of bodies on joints the freedoms of these.

    Args:
        bodies, paces: by name.
        branches: bodies on joints, parents before children.

    Returns:
        The layout, and the links of the frames of its kinematics, in their order.
    """
    ends: dict[Part, int] = {"s": 0, "f": 0}
    on_joints = {branch.child: branch for branch in branches}
    own, places, freedoms = {}, {}, {}
    for name, body in bodies.items():
        part: Part = "f" if paces[name].value == "fast" else "s"
        branch = on_joints.get(name)
        if branch is None:
            own[name] = places[name] = Place(part, ends[part], body.size)
            ends[part] += body.size
            continue
        for freedom, label in zip(branch.joint.freedoms, branch.labels(bodies), strict=True):
            own[label] = freedoms[branch.joint.name, branch.element, freedom] = Place(part, ends[part], 1)
            ends[part] += 1
    if not branches:
        return Layout(places, own), ()
    return _with_kinematics(bodies, branches, places, own, freedoms, (ends["s"], ends["f"]))


def _with_kinematics(bodies: Bodies, branches: Sequence[Branch], places, own, freedoms, sizes):
    """The layout with the bodies on joints, and the links of their frames."""
    grids: dict[str, Grid] = {name: place.part for name, place in places.items()}
    grids[GROUND] = "s"
    depths: dict[str, int] = {}
    for branch in branches:
        parts = {freedoms[key].part for key in branch.keys}
        parts |= set() if branch.parent == GROUND else {*grids[branch.parent]}
        grids[branch.child] = "sf" if len(parts) > 1 else parts.pop() if parts else "s"
        depths[branch.child] = depths.get(branch.parent, 0) + 1
    roots = list(dict.fromkeys(branch.parent for branch in branches if branch.parent in places))
    numbers = {GROUND: -1} | {name: i for i, name in enumerate(roots)}
    carriers = _carriers_of_fast(branches, grids)
    # by grid, and whether fast bodies need them; in the order of `Kinematics.frames`
    groups: dict[tuple[Grid, bool], list[Branch]] = {
        ("s", True): [],
        ("f", True): [],
        ("sf", True): [],
        ("s", False): [],
    }
    for branch in branches:
        grid = grids[branch.child]
        groups[grid, grid != "s" or branch.child in carriers].append(branch)
    frames, links, carried, num_fast = [], [], [], 0
    for (grid, is_needed), some in groups.items():
        some.sort(key=lambda branch: depths[branch.child])  # as the frames are: taken by few slices
        if some:
            made, ordered = _frames(grid, len(links), some, bodies, freedoms, numbers)
            numbers |= {branch.child: len(roots) + len(carried) + i for i, branch in enumerate(some)}
            frames.append(made)
            links += ordered
            carried += [branch.child for branch in some]
            num_fast += is_needed
    kinematics = Kinematics(tuple(places[name] for name in roots), tuple(frames), sizes, num_fast)
    where = dict(zip(carried, kinematics.places, strict=True))
    everywhere = {name: places.get(name) or where[name] for name in bodies}
    return Layout(everywhere, own, freedoms, kinematics), tuple(links)


def _carriers_of_fast(branches: Sequence[Branch], grids: Mapping[str, Grid]) -> set[str]:
    """The bodies that carry, at any depth, bodies which depend on fast coordinates."""
    found: set[str] = set()
    for branch in reversed(branches):  # children before parents
        if grids[branch.child] != "s" or branch.child in found:
            found.add(branch.parent)
    return found


def _frames(grid: Grid, first: int, branches: Sequence[Branch], bodies: Bodies, freedoms, numbers: Mapping[str, int]):
    """The frames of bodies that depend on the same coordinates, and their links in the same order, None beyond the end of a way.

    Args:
        first: number of their first frame.
        branches: parents before children.
        numbers: of the bodies that they may hang on.
    """
    branch_of = {branch.child: branch for branch in branches}
    outermost = [branch for branch in branches if all(other.parent != branch.child for other in branches)]
    ways = [_way(branch, branch_of) for branch in outermost]
    depth = max(map(len, ways))
    links = [way[level] if level < len(way) else None for level in range(depth) for way in ways]
    coordinates = [freedoms[link.key] for link in links if link is not None and link.key is not None]
    which = iter(range(len(coordinates)))
    frames = Frames(
        grid,
        first,
        tuple(numbers[way[0].branch.parent] for way in ways),
        Rows.of(coordinates) if coordinates else None,
        tuple(-1 if link is None or link.key is None else next(which) for link in links),
        any(link is not None and link.move is not None and link.move.kind != "turn" for link in links),
        tuple(links.index(Link(branch, branch.size - 1)) for branch in branches),
        tuple(bodies[branch.child].wide for branch in branches),
    )
    return frames, links


def _way(branch: Branch | None, branch_of: Mapping[str, Branch]) -> list[Link]:
    """The links from a root to the body of a branch."""
    way: list[Link] = []
    while branch is not None:
        way = [*(Link(branch, step) for step in range(branch.size)), *way]
        branch = branch_of.get(branch.parent)
    return way


def joint_numbers(bodies: Bodies, links: Sequence[Link | None]) -> dict[str, Any]:
    """The constants C, P, S, E (n, 4, 3) of all links, see `vmri_jax.mechanics.kinematics`; of None those of what does not move.

    Args:
        bodies: by name.
        links: of a layout.
    """
    known = list(dict.fromkeys(link for link in links if link is not None))
    ends = _ends(bodies, known)
    xp = library(ends)
    axes = [link.move.axis if link.move else 2 for link in known]
    cyclic = np.array([[(k + 1) % 3, (k + 2) % 3, k] for k in axes])
    inner, outer = (ends[name][np.arange(len(known))[:, None], cyclic] for name in ("frame_a", "frame_b"))

    def dyads(i: int, j: int):
        return outer[:, i, :, None] * inner[:, j, None, :]

    def rows(matrix, point):
        """(r, M) with ``r = X - X_b M``."""
        turned = xp.sum(ends["point_b"][:, :, None] * matrix, axis=1)
        return xp.concatenate([(point - turned)[:, None], matrix], axis=1)

    turns, ways = (np.array([link.amount(kind) for link in known])[:, None, None] for kind in ("turn", "slide"))
    pitches = [link.pitch / (2 * np.pi) for link in known]
    screws = library(pitches).stack(pitches)[:, None]
    across, along = dyads(0, 0) + dyads(1, 1), dyads(2, 2)
    zero = xp.zeros_like(ends["point_a"])
    found = {
        "constant": rows(along + (1 - np.abs(turns)) * across, ends["point_a"]),
        "cosine": rows(np.abs(turns) * across, zero),
        "sine": rows(turns * (dyads(0, 1) - dyads(1, 0)), zero),
        "way": xp.pad(((ways[:, 0] + turns[:, 0] * screws) * inner[:, 2])[:, None], ((0, 0), (0, 3), (0, 0))),
    }
    which = np.array([len(known) if link is None else known.index(link) for link in links])
    unmoved = {name: UNMOVED if name == "constant" else np.zeros((4, 3)) for name in found}
    return {name: xp.concatenate([values, unmoved[name][None]])[which] for name, values in found.items()}


def _ends(bodies: Bodies, links: Sequence[Link]) -> dict[str, Any]:
    """Points and triads of all links in what they hang on and in their own frames, "point_a", "frame_a", "point_b", "frame_b"."""
    carried = {link.branch.child for link in links}
    joints = {link.branch.joint.name: link.branch.joint for link in links}
    points = {name: joint.joining_points(bodies) for name, joint in joints.items()}
    triads: dict[str, Any] = {name: joint.frame(len(points[name])) for name, joint in joints.items()}
    found: dict[str, list] = {}
    for link in links:
        branch = link.branch
        point, triad = points[branch.joint.name][branch.element], triads[branch.joint.name][branch.element]
        first, last = (0, 1) if branch.forward else (1, 0)
        for role, name, which, here in (
            ("a", branch.parent, first, link.is_first),
            ("b", branch.child, last, link.is_last),
        ):
            body = body_of(bodies, name)
            along = body.components if isinstance(body, RigidBody) and name in carried else body.weights
            at = along((point[which] - body.position) @ body.rotation) if here else np.zeros(3)
            axes = [along(row @ body.rotation) for row in triad] if here else list(np.eye(3))
            found.setdefault(f"point_{role}", []).append(at)
            found.setdefault(f"frame_{role}", []).append(library(axes).stack(axes))
    return {name: library(values).stack(values) for name, values in found.items()}


def nearest_rates(jacobian, rates, masses) -> tuple[Any, Any]:
    """The velocities v of the scene nearest to those V of the bodies, ``J^T M J v = J^T M V``.

    Args:
        jacobian: J = dQ/dq.
        rates, masses: V and the masses M of (Q_s, Q_f) one after the other.

    Returns:
        v, and the part of V that the joints do not allow, in the norm of the kinetic energy.
    """
    xp = library(jacobian, rates, masses)
    v = xp.linalg.solve(jacobian.T @ (masses[:, None] * jacobian), jacobian.T @ (masses * rates))
    missed, whole = rates - jacobian @ v, xp.sum(masses * rates**2)
    return v, xp.sqrt(xp.sum(masses * missed**2) / xp.where(whole > 0, whole, 1.0))

"""Random trees and rings of rigid bodies on joints: roots on the ground or free, every kind of joint, springs, dampers,
forces."""

from typing import Any

import numpy as np

from vmri_jax import scene as sc

JOINTS = (sc.Revolute, sc.Prismatic, sc.Cylindrical, sc.Universal, sc.Fixed, sc.Spherical, sc.Screw, sc.Planar)
BODIES = 4
FREEDOMS = 8
"""Fewest freedoms of the joints of a ring: six close it, and two more let it move and let one joint start elsewhere."""


def random_scene(seed: int) -> tuple[sc.Scene, dict[str, tuple[float, float]]]:
    """A scene in joint coordinates at rest, and random starts of all its freedoms (value, rate) by joint and freedom.

    Args:
        seed: of the random numbers; the ground carries trees of odd ones.
    """
    random = np.random.default_rng(seed)
    bodies, effects, starts = [], [], {}
    names = ["ground"] if seed % 2 else []
    for i in range(BODIES):
        name, place = f"body {i}", random.normal(size=3)
        pace = "fast" if i and random.random() < 0.5 else "slow"
        shape = sc.Box(tuple(random.uniform(0.5, 1.5, size=3)))
        bodies.append(sc.RigidBody(name, random.uniform(0.5, 2.0), shape, place, random.normal(size=3), pace=pace))
        if names:
            parent, kind = random.choice(names), JOINTS[random.integers(len(JOINTS))]
            pair = (parent, name) if random.random() < 0.5 else (name, parent)
            effects += _on_joint(kind, pair, f"joint {i}", random, starts)
        names.append(name)
    ends = ("body 2", random.normal(size=3) / 5), ("body 3", random.normal(size=3) / 5)
    effects += [sc.Gravity([0.3, 0.2, -1.0]), sc.Spring(ends, 3.0, 0.4)]
    return sc.Scene(bodies, effects, coordinates="joint"), starts


def random_ring(seed: int) -> tuple[sc.Scene, dict[str, dict[str, tuple[float, float]]]]:
    """As `random_scene`, of bodies in one closed loop, from the ground back to the ground or from a free body back to
    it.

    Args:
        seed: of the random numbers; the ground is in rings of odd ones.
    """
    random = np.random.default_rng(seed)
    names = (["ground"] if seed % 2 else []) + [f"body {i}" for i in range(BODIES)]
    kinds: list[Any] = []
    while sum(max(1, len(kind.freedoms)) for kind in kinds) < FREEDOMS:
        kinds = [JOINTS[i] for i in random.integers(len(JOINTS), size=len(names))]
    bodies, effects, starts = [], [], {}
    for name in names[-BODIES:]:
        shape = sc.Box(tuple(random.uniform(0.5, 1.5, size=3)))
        bodies.append(sc.RigidBody(name, random.uniform(0.5, 2.0), shape, random.normal(size=3), random.normal(size=3)))
    for i, kind in enumerate(kinds):
        pair = names[i], names[(i + 1) % len(names)]
        effects += _on_joint(kind, pair[:: random.choice((-1, 1))], f"joint {i}", random, starts)
    return sc.Scene(bodies, [sc.Gravity([0.3, 0.2, -1.0]), *effects], coordinates="joint"), starts


def _on_joint(kind, pair, name: str, random, starts) -> list[sc.Effect]:
    """A joint, with a spring and a damper in every freedom."""
    axis = random.normal(size=3)
    second = np.cross(axis, random.normal(size=3))
    axes: dict[str, Any] = (
        {}
        if kind is sc.Spherical
        else {"axis": axis}
        | ({"second": second} if kind is sc.Universal else {"pitch": 0.5} if kind is sc.Screw else {})
    )
    joint = kind(pair, at=random.normal(size=3), name=name, **axes)
    found: list[sc.Effect] = [joint]
    for freedom in joint.freedoms if joint.carries else ():
        label = f"{name} {freedom}"
        neutral = random.normal() / 5
        found.append(sc.JointSpring(name, 2.0, neutral, of=freedom, name=f"{label} spring"))
        found.append(sc.JointDamper(name, 0.1, of=freedom, name=f"{label} damper"))
        starts.setdefault(name, {})[freedom] = (random.normal() / 4, random.normal() / 4)
    return found

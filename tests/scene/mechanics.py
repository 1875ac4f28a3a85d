"""The mechanics of a scene as values of functions, which scenes of the same bodies share whatever their coordinates
are."""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import numpy as np

from vmri_jax.mechanics.projection import legendre
from vmri_jax.mechanics.state import State
from vmri_jax.scene import Scene


class Mechanics(NamedTuple):
    """Coordinates and rates of all bodies by name, the energies, the power of the forces, and the rows of all
    constraints."""

    bodies: dict
    kinetic: float
    potential: float
    power: float
    rows: np.ndarray


def mechanics(scene: Scene, start=None, t: float = 0.0) -> Mechanics:
    """The mechanics of a scene at its start, or at other ``(q_s, q_f, v_s, v_f)``."""
    start = scene.start if start is None else start
    layout = scene.sorting.layout
    slow_and_fast = start
    if layout.kinematics is not None:
        slow_and_fast = jax.device_get(_of_bodies(layout.kinematics, scene.sorting.joints, *start))
    q, v = slow_and_fast[:2], slow_and_fast[2:]
    bodies = {
        name: tuple(np.asarray(x[part == "f"][first : first + size]) for x in (q, v))
        for name, (part, first, size) in layout.bodies.items()
    }
    kinetic, potential, power, rows = values(scene.system(), t, *start)
    return Mechanics(bodies, float(kinetic), float(potential), float(power), np.asarray(rows))


@jax.jit
def values(system, t, q_s, q_f, v_s, v_f):
    """Kinetic and potential energy, power of the forces, and all rows of a system."""
    slow, fast = system.forces(t, q_s, q_f, v_s, v_f)
    potential = sum(system.all_potentials(q_s, q_f).values())
    power = slow @ v_s + fast @ v_f
    return system.kinetic_energy(q_s, q_f, v_s, v_f), potential, power, system.constraints(t, q_s, q_f)


@partial(jax.jit, static_argnums=0)
def _of_bodies(kinematics, joints, q_s, q_f, v_s, v_f):
    return *kinematics(q_s, q_f, joints), *kinematics.velocities(q_s, q_f, v_s, v_f, joints)


def by_directors(scene: Scene, bodies: dict) -> tuple[Scene, tuple]:
    """The scene by directors, all of them slow, and its ``(q_s, q_f, v_s, v_f)`` with these coordinates and rates of
    bodies."""
    slow = [replace(body, pace="slow") for body in scene.bodies]
    twin = replace(scene, bodies=slow, coordinates="directors", joint_starts={})
    q, v = (np.concatenate([bodies[name][k] for name in twin.places]) for k in range(2))
    none = np.zeros(0)
    return twin, (q, none, v, none)


def state_by_directors(scene: Scene, bodies: dict) -> tuple[Scene, State]:
    """As `by_directors`, with the state."""
    twin, start = by_directors(scene, bodies)
    return twin, State(np.zeros(()), *start[:2], *jax.jit(legendre)(twin.system(), *start))


def assert_same_mechanics(ours: Mechanics, theirs: Mechanics, atol: float = 1e-12) -> None:
    """Bodies, energies and power are the same; rows are left to the test."""
    for name, expected in theirs.bodies.items():
        for a, b in zip(ours.bodies[name], expected, strict=True):
            np.testing.assert_allclose(a, b, atol=atol)
    np.testing.assert_allclose(ours[1:4], theirs[1:4], rtol=1e-11, atol=atol)


def assert_mechanics_as_by_directors(scene: Scene, seed: int = 0, t: float = 0.0) -> None:
    """At random coordinates x of joints the rows of bodies and joints by directors are zero, and energies and the power
    of forces are the same.

    So the equations of motion are the same too: the Lagrangian of x is ``L(q(x), q'(x) v)``, and reactions do no work
    along ``q'(x)``.
    """
    random = np.random.default_rng(seed)
    sizes = (scene.names.slow, scene.names.fast) * 2
    of_joints = [
        np.concatenate([np.full(n, name not in scene.by_name) for name, n in size.items()] or [[]]) for size in sizes
    ]
    for _ in range(3):
        moved = [
            x + scale * free * random.normal(size=x.shape)
            for x, free, scale in zip(scene.start, of_joints, (0.3, 0.3, 1.0, 1.0), strict=True)
        ]
        ours = mechanics(scene, moved, t)
        twin, there = by_directors(scene, ours.bodies)
        theirs = mechanics(twin, there, t)
        assert_same_mechanics(ours, theirs)
        carried = {branch.joint.name for branch in scene.branches}
        held = [
            i for name, rows in twin.names.rows.items() if name in carried or name.startswith("rigid") for i in rows
        ]
        np.testing.assert_allclose(theirs.rows[np.array(held)], 0.0, atol=1e-12)
